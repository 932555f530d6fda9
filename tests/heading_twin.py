"""Heading bin by bin, with NumPy and SciPy and full matrices: what the kernels are held against."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import multivariate_t

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation import heading_arrays as at
from xsens.fusion import heading as constants
from xsens.fusion.heading import FieldModel
from xsens.fusion.settings import FusionSettings

ROOM, BIAS, IRON, PLACE, STRAY = (slice(first, first + 3) for first in (0, 3, 6, 9, 12))
LAG = 15
SIZE = 16


@dataclass(frozen=True)
class Bin:
    """What a bin of readings reads.

    Attributes
    ----------
    span_s : float
    rests, seen : bool
    slip, bias_variance, tilt : float
        Variances, rad^2, (rad/s)^2 and rad^2.
    bias_change, field, late : ndarray, shape (3,)
        rad/s; over the norm; 1/s.
    pose, correction : ndarray, shape (3, 3)
        Level axes from the sensor's; turn of the level axes.
    """

    span_s: float
    rests: bool
    seen: bool
    slip: float
    bias_variance: float
    tilt: float
    bias_change: FloatArray
    field: FloatArray
    late: FloatArray
    pose: FloatArray
    correction: FloatArray


def bins_from(rows: FloatArray, norm: float, bias_change: FloatArray | None = None) -> list[Bin]:
    """Bins of rows as `averaged_bins` makes them, their fields as fractions of `norm`."""
    changes = np.zeros((len(rows), 3)) if bias_change is None else bias_change
    return [
        Bin(
            row[at.SPAN],
            row[at.RESTS] > 0.0,
            row[at.SEEN] > 0.0,
            row[at.SLIP],
            row[at.BIAS_VARIANCE],
            row[at.TILT],
            change,
            row[at.READING : at.READING + 3] / norm,
            row[at.LATE : at.LATE + 3] / norm,
            row[at.POSE : at.POSE + 9].reshape(3, 3),
            row[at.CORRECTION : at.CORRECTION + 9].reshape(3, 3),
        )
        for row, change in zip(rows, changes, strict=True)
    ]


# -- forward


@dataclass(frozen=True)
class Step:
    """A filter in one bin; `turn` and `evidence` are NaN where there is none.

    Attributes
    ----------
    transition, noise : ndarray, shape (16, 16)
    shows, reading, reading_noise : ndarray, shapes (3, 16), (3,) and (3, 3)
        None in a bin without a reading; the noise is that of a reading believed as far as it was.
    predicted_mean, predicted : ndarray, shapes (16,) and (16, 16)
        Before the reading.
    mean, covariance : ndarray, shapes (16,) and (16, 16)
    turn, variance, evidence, trust : float
    """

    transition: FloatArray
    noise: FloatArray
    shows: FloatArray | None
    reading: FloatArray | None
    reading_noise: FloatArray | None
    predicted_mean: FloatArray
    predicted: FloatArray
    mean: FloatArray
    covariance: FloatArray
    turn: float
    variance: float
    evidence: float
    trust: float


class HeadingFilter:
    """Extended Kalman filter of one model.

    State: the room's field (level axes), what is left of the gyroscope's bias (sensor axes), the field of
    iron (sensor axes), those of the place and the stray (level axes), and the magnetometer's lag.
    """

    def __init__(self, model: FieldModel, settings: FusionSettings, first_stray: float = 1.0) -> None:
        self.model, self.settings, self.first_stray = model, settings, first_stray
        self.x, self.p = np.zeros(SIZE), np.zeros((SIZE, SIZE))
        self.begun = self.ran = self.rested = False
        self.holding_s = self.moved_s = 0.0

    def resume(self) -> None:
        """Begin again after a pause."""
        self.begun = False

    def run(self, bins: list[Bin]) -> list[Step | None]:
        """Run over bins; None before it has begun."""
        return [self._advance(one) for one in bins]

    def _advance(self, one: Bin) -> Step | None:
        self.moved_s += 0.0 if one.rests else one.span_s
        if not self.begun and one.seen and self.moved_s >= self.model.after_s:
            self._begin(one)
        if not self.begun:
            return None
        transition, noise = self._model(one)
        self.x[BIAS] -= one.bias_change
        self.x = transition @ self.x
        self.p = transition @ self.p @ transition.T + noise
        shows = reading_noise = None
        evidence, trust = math.nan, 0.0
        if one.seen:
            shows = np.hstack(
                [np.eye(3), np.zeros((3, 3)), one.pose, np.eye(3), np.eye(3), one.late[:, None]]
            )
            reading_noise = self._reading_noise(one)
            jump = self._jump(one, shows, reading_noise)
            noise, self.p = noise + jump, self.p + jump
        predicted_mean, predicted = self.x, self.p
        if one.seen:
            evidence, trust, reading_noise = self._correct(one, shows, reading_noise)
        turns = block_diag(one.correction, np.eye(6), one.correction, one.correction, 1.0)
        self.x, self.p = turns @ self.x, turns @ self.p @ turns.T
        turn, variance = north(self.x, self.p)
        reading = one.field if one.seen else None
        made = (transition, noise, shows, reading, reading_noise, predicted_mean, predicted)
        return Step(*made, self.x, self.p, turn, variance, evidence, trust)

    def _begin(self, one: Bin) -> None:
        s, model = self.settings, self.model
        iron, lag = self.x[IRON], self.x[LAG]
        kept = self.p[np.ix_([6, 7, 8, LAG], [6, 7, 8, LAG])]
        if not self.ran:
            iron, lag, kept = np.zeros(3), 0.0, np.diag([model.iron**2] * 3 + [s.magnetometer_lag_s**2])
        place = s.field_place if self.ran else s.field_first_place
        stray = self.first_stray * model.stray
        variances = [constants.ROOM**2, one.bias_variance, 0.0, place**2, stray**2]
        self.p = np.diag([*np.repeat(variances, 3), 0.0])
        self.p[np.ix_([6, 7, 8, LAG], [6, 7, 8, LAG])] = kept
        self.x = np.concatenate([one.field - one.pose @ iron, np.zeros(3), iron, np.zeros(6), [lag]])
        self.begun = self.ran = True
        self.rested, self.holding_s = one.rests, 0.0

    def _model(self, one: Bin) -> tuple[FloatArray, FloatArray]:
        """Transition and noise."""
        model, span = self.model, one.span_s
        keep = np.ones(SIZE)
        noise = np.zeros((SIZE, SIZE))
        if one.rests != self.rested:
            keep[PLACE] = 0.0
            noise[PLACE, PLACE] = self.settings.field_place**2 * np.eye(3)
        self.rested = one.rests
        keep[BIAS] = math.exp(-span / constants.BIAS_S)
        noise[BIAS, BIAS] = (1.0 - keep[BIAS] ** 2) * one.bias_variance * np.eye(3)
        turns = np.eye(SIZE)
        if not one.rests:
            keep[STRAY] = math.exp(-span / model.stray_s)
            noise[STRAY, STRAY] = (1.0 - keep[STRAY] ** 2) * model.stray**2 * np.eye(3)
            turns[0, BIAS] = -self.x[1] * span * one.pose[2]
            turns[1, BIAS] = self.x[0] * span * one.pose[2]
        noise = turns @ noise @ turns.T
        across = np.array([-self.x[1], self.x[0], 0.0])
        noise[ROOM, ROOM] += one.slip * np.outer(across, across)
        noise[ROOM, ROOM] += constants.ROOM_WALK_SQRT_S**2 * span * np.eye(3)
        if self.holding_s > 0.0:
            self.holding_s -= span
            noise[IRON, IRON] += model.iron_put_on**2 * np.eye(3)
        return turns @ np.diag(keep), noise

    def _reading_noise(self, one: Bin) -> FloatArray:
        x, y, z = self.x[ROOM]
        white = self.settings.field_noise_sqrt_s**2 / one.span_s
        return white * np.eye(3) + one.tilt * np.diag([z**2, z**2, x**2 + y**2])

    def _jump(self, one: Bin, shows: FloatArray, reading_noise: FloatArray) -> FloatArray:
        """Noise of iron that the reading shows to be put on."""
        jump = np.zeros((SIZE, SIZE))
        off = one.field - shows @ self.x
        misfit = off @ np.linalg.inv(shows @ self.p @ shows.T + reading_noise) @ off
        if misfit > constants.OUTLIER and self.model.iron_put_on > 0.0 and self.holding_s <= 0.0:
            self.holding_s = constants.HOLD_S
            jump[IRON, IRON] = self.model.iron_put_on**2 * np.eye(3)
        return jump

    def _correct(
        self, one: Bin, shows: FloatArray, reading_noise: FloatArray
    ) -> tuple[float, float, FloatArray]:
        """Correct by the reading, whose errors have Student's distribution; a constant is left out of it."""
        freedom = constants.FREEDOM
        off = one.field - shows @ self.x
        spread = shows @ self.p @ shows.T + reading_noise
        evidence = multivariate_t.logpdf(off, shape=spread, df=freedom) + 1.5 * math.log(math.pi)
        trust = min((freedom + 3.0) / (freedom + off @ np.linalg.inv(spread) @ off), 1.0)
        reading_noise = reading_noise + (1.0 / trust - 1.0) * np.trace(spread) / 3.0 * np.eye(3)
        gain = self.p @ shows.T @ np.linalg.inv(shows @ self.p @ shows.T + reading_noise)
        self.x = self.x + gain @ off
        keep = np.eye(SIZE) - gain @ shows
        self.p = keep @ self.p @ keep.T + gain @ reading_noise @ gain.T
        return float(evidence), float(trust), reading_noise


def north(x: FloatArray, p: FloatArray) -> tuple[float, float]:
    """Angle from the level axes to north, and its variance."""
    slope = np.array([x[1], -x[0]]) / (x[0] ** 2 + x[1] ** 2)
    return -math.atan2(x[1], x[0]), min(float(slope @ p[:2, :2] @ slope), math.pi**2)


# -- backward


def smoothed(steps: list[Step]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angle and variance in every bin, and the first one's bias, by all readings at once.

    By the filter's linear model, the states of all bins have one normal distribution; it is conditioned on
    all readings in one go.
    """
    n = len(steps)
    prior = np.zeros((n, SIZE, n, SIZE))
    prior[0, :, 0] = steps[0].predicted
    means = [steps[0].predicted_mean]
    for k in range(1, n):
        transition = steps[k].transition
        means.append(transition @ means[-1])
        for j in range(k):
            prior[k, :, j] = transition @ prior[k - 1, :, j]
            prior[j, :, k] = prior[k, :, j].T
        prior[k, :, k] = transition @ prior[k - 1, :, k - 1] @ transition.T + steps[k].noise
    joint, mean = prior.reshape(n * SIZE, n * SIZE), np.concatenate(means)
    seen = [k for k in range(n) if steps[k].shows is not None]
    shows = np.zeros((3 * len(seen), n * SIZE))
    for i, k in enumerate(seen):
        shows[3 * i : 3 * i + 3, k * SIZE : (k + 1) * SIZE] = steps[k].shows
    noise = block_diag(*[steps[k].reading_noise for k in seen])
    cross = joint @ shows.T
    gain = np.linalg.solve(shows @ cross + noise, cross.T).T
    mean = mean + gain @ (np.concatenate([steps[k].reading for k in seen]) - shows @ mean)
    joint = joint - gain @ cross.T
    parts = [slice(k * SIZE, (k + 1) * SIZE) for k in range(n)]
    turns, variances = zip(*[north(mean[part], joint[part, part]) for part in parts], strict=True)
    return np.array(turns), np.array(variances), mean[BIAS]


def carried_back(bins: list[Bin], first: int, bias: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Turn and variance that the gyroscope adds in the bins before `first`, going back from there."""
    turns, variances = [0.0], [0.0]
    for one in reversed(bins[1 : first + 1]):
        moving_s = 0.0 if one.rests else one.span_s
        turns.append(turns[-1] + moving_s * one.pose[2] @ bias)
        variances.append(variances[-1] + one.slip + moving_s**2 * one.bias_variance)
    return np.array(turns[:0:-1]), np.array(variances[:0:-1])
