"""Turn level axes, carried by the gyroscope, to magnetic north: a bank of filters with models of the field.

The field that a moving sensor reads is the room's, plus what the place adds (another one for each stay at
rest and for the movement between), plus a stray that changes as it moves on, plus the field of iron on the
sensor, all as vectors. Norm and dip, which tell nothing of the heading, tell how large those are here: each
model states other sizes, each filter's evidence tells how well its model explains the readings, and the
headings are averaged with those weights. So a quiet room's field is followed closely and a poor one's hardly,
iron that is put on the sensor is found by turning it, and the claimed deviation is that of the room at hand.
Two properties of the sensor are found on the way: the lag of its magnetometer (its readings are older than
the gyroscope's), and the gyroscope's bias in movement, which is not quite that at rest.

North is the field's where the sensor was at first.

References
----------
.. [1] D. T. Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE TAC 10, 1965 (the
   bank).
.. [2] M. Roth, E. Ozkan, F. Gustafsson, "A Student's t filter for heavy tailed process and measurement
   noise", ICASSP 2013 (readings off the model).
.. [3] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems",
   AIAA J., 1965 (the smoother).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.kernels.orientation import heading_arrays as at
from speckle3d.kernels.orientation.heading import find_headings, turn_to_north
from xsens.fusion.settings import FusionSettings


@dataclass(frozen=True)
class FieldModel:
    """One explanation of the field.

    Attributes
    ----------
    stray : float
        Deviation of the field from that of its place, as a fraction of the field's norm, per component.
    stray_s : float
        How long it persists while the sensor moves.
    iron : float
        Deviation of the field of iron on the sensor at the start, as a fraction.
    iron_put_on : float
        That of iron put on the sensor later, added in each bin while it is put on (`HOLD_S`); zero if none
        ever is.
    after_s : float
        How long the sensor must have moved before the field is used: the first place may be beside iron.
    handicap : float
        Logarithm of the evidence that the others must lack before this one is taken; of iron put on, in
        recordings that move for no longer than `PROVED_S`.
    online_handicap : float, optional
        The same while samples arrive, when evidence is short.
    """

    stray: float
    stray_s: float = 2.0
    iron: float = 0.0003
    iron_put_on: float = 0.0
    after_s: float = 0.0
    handicap: float = 0.0
    online_handicap: float | None = None


MODELS = (
    *(FieldModel(stray) for stray in (0.005, 0.01, 0.02, 0.04, 0.08, 0.16)),
    *(FieldModel(stray, stray_s=8.0, handicap=50.0) for stray in (0.02, 0.05, 0.12, 0.3)),
    *(
        FieldModel(stray, after_s=after_s, handicap=100.0)
        for stray in (0.01, 0.03)
        for after_s in (3.0, 10.0)
    ),
    *(FieldModel(0.1, stray_s=8.0, after_s=after_s, handicap=100.0) for after_s in (3.0, 10.0)),
    *(
        FieldModel(stray, iron=0.02, iron_put_on=0.15, handicap=300.0, online_handicap=100.0)
        for stray in (0.005, 0.01, 0.02, 0.04, 0.08)
    ),
    *(
        FieldModel(stray, iron=0.7, iron_put_on=0.15, handicap=300.0, online_handicap=100.0)
        for stray in (0.01, 0.03, 0.08)
    ),
)
"""Rooms from a quiet one to a workshop; those that are walked through; a start beside iron; iron put on the
sensor; and iron on it from the start. The later ones must be proved: a sensor that is turned while it is
carried through an uneven field shows nearly the same as one with iron on it."""

PROVED_S = 150.0
"""Longer movement proves iron by as much more: an uneven field that looks like it does so all the time."""

BIAS_S = 10.0
"""How long what is left of the gyroscope's bias persists."""

ROOM = 1.0
"""Deviation of the room's field from its first reading, as a fraction: nothing is known of it."""

ROOM_WALK_SQRT_S = 0.0003
"""Its random walk: 1 % in twenty minutes."""

FREEDOM = 3.0
"""Of Student's distribution of the readings' errors."""

OUTLIER = 25.0
"""Squared misfit of a reading that shows iron put on or off: one in 10^5 with normal errors."""

HOLD_S = 3.0
"""How long putting it on takes."""

FIRST_STRAY = 0.25
"""The first reading's stray while samples arrive, as a fraction of a model's: the first readings are all
there is, and models of rough rooms would swing the heading about. A recording tells it in full."""

MEMORY_S = 300.0
"""Time over which models are weighed while samples arrive; a recording is weighed as a whole."""

_DISTRUSTED = 0.5
_ROUNDING = 1e-12
"""Variance that keeps covariances invertible: (1 microradian)^2, a millionth of the field, 1 microsecond."""

_NEGLIGIBLE = 5.0
"""Models whose evidence is less by this, in logarithms, are not smoothed: their weight is below 1 %."""


@dataclass(frozen=True)
class Headings:
    """Angle about up from level axes to north, at the end of each bin.

    Attributes
    ----------
    turn_rad, sd_rad : ndarray, shape (n,)
    disturbed : ndarray of bool, shape (n,)
        Where the reading was hardly believed.
    stray : ndarray, shape (n,)
        How much the field changes from place to place, as the models have it that explain the readings best:
        a fraction of its norm, per component.
    iron : ndarray, shape (n,)
        Weight of the models that take iron to be on the sensor, 0 to 1.
    """

    turn_rad: FloatArray
    sd_rad: FloatArray
    disturbed: BoolArray
    stray: FloatArray
    iron: FloatArray


# -- the bank


class HeadingBank:
    """The filters of all models, bin by bin.

    Parameters
    ----------
    settings : FusionSettings
    models : tuple of FieldModel
    first_stray : float
        Deviation of the stray in the first reading, as a fraction of that of each model.
    """

    def __init__(
        self,
        settings: FusionSettings,
        models: tuple[FieldModel, ...] = MODELS,
        first_stray: float = FIRST_STRAY,
    ) -> None:
        self.models = models
        self._table = np.array([[m.stray, m.stray_s, m.iron, m.iron_put_on, m.after_s] for m in models])
        self._handicap = np.array([m.handicap for m in models])
        online = [m.handicap if m.online_handicap is None else m.online_handicap for m in models]
        self._online_handicap = np.array(online)
        self._iron_put_on = np.array([m.iron_put_on > 0.0 for m in models])
        self._moved_s = 0.0
        self._shared = _shared(settings, first_stray)
        count = len(models)
        self._means, self._flags = np.zeros((count, at.STATES)), np.zeros((count, at.FLAGS))
        self._covariances = np.zeros((count, at.STATES, at.STATES))
        self._scores = np.full(count, np.nan)
        self._norm = math.nan
        self._bias: FloatArray | None = None

    def resume(self) -> None:
        """Find north again after a pause; keep iron, lag and the weights of the models."""
        self._flags[:, at.BEGUN] = 0.0
        self._bias = None

    def follow(self, bins: FloatArray, bias_rad_s: FloatArray) -> Headings:
        """Take in bins; `bias_rad_s`, shape (n, 3), is the bias with which each one's steps ended."""
        rows = bins.copy()
        before = bias_rad_s[:1] if self._bias is None else self._bias[None]
        rows[:, at.BIAS_CHANGE : at.BIAS_CHANGE + 3] = np.diff(bias_rad_s, axis=0, prepend=before)
        self._bias = bias_rad_s[-1].copy()
        self._know_norm(rows, 1)
        found = self._run(rows)
        turns, variances = found[..., at.FOUND_TURN], found[..., at.FOUND_VARIANCE]
        weights = np.array(
            [
                self._weighed(row[at.SPAN], row[at.RESTS] > 0.0, evidence)
                for row, evidence in zip(rows, found[..., at.EVIDENCE], strict=True)
            ]
        )
        return _mixed(turns, variances, found[..., at.TRUST], weights, rows[:, at.SEEN] > 0.0, self.models)

    def evidence(self, bins: FloatArray) -> FloatArray:
        """Logarithm of each model's evidence in all bins, less its handicap, shape (models,).

        Of the bins before a model that begins late, it is given the evidence of the best of the others.
        """
        each = self._run(bins)[..., at.EVIDENCE]
        running = np.cumsum(np.nan_to_num(each), axis=0)
        begun = np.isfinite(each)
        first = np.where(begun.any(axis=0), begun.argmax(axis=0), len(bins))
        total = running[-1].copy()
        early = first == first.min()
        for late in np.flatnonzero(~early):
            k = min(first[late], len(bins)) - 1
            total[late] += running[k, early].max()
        moved_s = float(bins[bins[:, at.RESTS] == 0.0, at.SPAN].sum())
        handicap = self._handicap * self._longer(moved_s)
        return np.asarray(np.where(begun.any(axis=0), total, -np.inf) - handicap)

    def kept(self, bins: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """States, covariances, those before the reading, and what was found, of every bin."""
        n, m = len(bins), len(self.models)
        wide = (n, m, at.STATES, at.STATES)
        states, after, before = np.zeros(wide[:3]), np.zeros(wide), np.zeros(wide)
        return states, after, before, self._run(bins, states, after, before)

    def _know_norm(self, bins: FloatArray, most: int) -> None:
        """Take the field's norm from the first readings, unless it is known: wild ones do not count."""
        readings = bins[bins[:, at.SEEN] > 0.0, at.READING : at.READING + 3][:most]
        if len(readings) and not math.isfinite(self._norm):
            self._norm = float(np.median(np.linalg.norm(readings, axis=1)))

    def _run(self, bins: FloatArray, *kept: FloatArray) -> FloatArray:
        rows = bins.copy()
        self._know_norm(rows, len(rows))
        if self._norm > 0.0:
            rows[:, at.READING : at.READING + 3] /= self._norm
            rows[:, at.LATE : at.LATE + 3] /= self._norm
        found = np.empty((len(rows), len(self.models), at.FOUND))
        wide = (0, len(self.models), at.STATES, at.STATES)
        into = kept or (np.empty(wide[:3]), np.empty(wide), np.empty(wide))
        table, shared = self._table, self._shared
        find_headings(rows, table, shared, self._means, self._covariances, self._flags, found, *into)
        return found

    def _longer(self, moved_s: float) -> FloatArray:
        """Factors of the models' handicaps after so long a movement."""
        return np.where(self._iron_put_on, max(1.0, moved_s / PROVED_S), 1.0)

    def _weighed(self, span_s: float, resting: bool, evidence: FloatArray) -> FloatArray:
        """Weights of the models after one more bin."""
        self._moved_s += 0.0 if resting else span_s
        seen, known = np.isfinite(evidence), np.isfinite(self._scores)
        late = seen & ~known
        if late.any():
            self._scores[late] = self._scores[known].max() if known.any() else 0.0
        self._scores[seen] = math.exp(-span_s / MEMORY_S) * self._scores[seen] + evidence[seen]
        handicap = self._online_handicap * self._longer(min(self._moved_s, MEMORY_S))
        return weights_of(self._scores - handicap)


def weights_of(evidence: FloatArray) -> FloatArray:
    """Weights of models by the logarithms of their evidence, NaN where a model has none."""
    if not np.isfinite(evidence).any():
        return np.full(len(evidence), 1.0 / len(evidence))
    likely = np.nan_to_num(np.exp(evidence - np.nanmax(evidence)))
    return np.asarray(likely / likely.sum())


def _mixed(
    turns: FloatArray,
    variances: FloatArray,
    trusts: FloatArray,
    weights: FloatArray,
    seen: BoolArray,
    models: tuple[FieldModel, ...],
) -> Headings:
    """Mean and deviation of the models' angles, (n, models), by weights, (n, models)."""
    best = np.take_along_axis(turns, weights.argmax(axis=1)[:, None], axis=1)
    off = np.angle(np.exp(1j * (turns - best)))
    mean = (weights * off).sum(axis=1)
    variance = (weights * (variances + (off - mean[:, None]) ** 2)).sum(axis=1)
    trust = (weights * trusts).sum(axis=1)
    stray = weights @ np.array([model.stray for model in models])
    iron = weights @ np.array([float(model.iron_put_on > 0.0) for model in models])
    return Headings(best[:, 0] + mean, np.sqrt(variance), seen & (trust < _DISTRUSTED), stray, iron)


def _shared(s: FusionSettings, first_stray: float) -> FloatArray:
    shared = np.full(at.SHARED, np.nan)
    for place, value in (
        (at.PLACE, s.field_place),
        (at.FIRST_PLACE, s.field_first_place),
        (at.WHITE, s.field_noise_sqrt_s),
        (at.BIAS_S, BIAS_S),
        (at.ROOM, ROOM),
        (at.ROOM_WALK, ROOM_WALK_SQRT_S),
        (at.FREEDOM, FREEDOM),
        (at.LAG_S, s.magnetometer_lag_s),
        (at.OUTLIER, OUTLIER),
        (at.HOLD_S, HOLD_S),
        (at.FIRST_STRAY, first_stray),
    ):
        shared[place] = value
    return shared


# -- a recording


def smooth_headings(bins: FloatArray, settings: FusionSettings) -> Headings:
    """North over a whole stretch: the models that explain it, smoothed backward."""
    evidence = HeadingBank(settings, first_stray=1.0).evidence(bins)
    chosen = np.flatnonzero(evidence > np.nanmax(evidence) - _NEGLIGIBLE)
    models = tuple(MODELS[k] for k in chosen)
    states, after, before, found = HeadingBank(settings, models, first_stray=1.0).kept(bins)
    turns, variances = np.empty((2, len(bins), len(models)))
    for j, model in enumerate(models):
        turns[:, j], variances[:, j] = _backward(bins, model, states[:, j], after[:, j], before[:, j])
    weights = np.tile(weights_of(evidence[chosen]), (len(bins), 1))
    return _mixed(turns, variances, found[..., at.TRUST], weights, bins[:, at.SEEN] > 0.0, models)


def _backward(
    bins: FloatArray,
    model: FieldModel,
    states: FloatArray,
    after: FloatArray,
    before: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Angle and variance of one model, smoothed."""
    from filterpy.kalman import KalmanFilter

    first = int(np.argmax(after[:, at.OF_ROOM, at.OF_ROOM] > 0.0))
    steps = _transitions(bins[first:], model, states[first:])
    noise = before[first:] + _ROUNDING * np.eye(at.STATES)
    noise[1:] -= steps[1:] @ after[first:-1] @ np.swapaxes(steps[1:], 1, 2)
    smoother = KalmanFilter(dim_x=at.STATES, dim_z=3)
    means, covariances, _, _ = smoother.rts_smoother(states[first:], after[first:], steps, noise)
    found = np.array([turn_to_north(x, p) for x, p in zip(means, covariances, strict=True)])
    turn, variance = np.unwrap(found[:, 0]), found[:, 1]
    early = bins[1 : first + 1]  # the field was not used yet: back by the gyroscope
    moving = early[:, at.RESTS] == 0.0
    up = early[:, at.POSE + 6 : at.POSE + 9]
    slip = moving * early[:, at.SPAN] * (up @ means[0, at.GYRO_BIAS : at.GYRO_BIAS + 3])
    spread = early[:, at.SLIP] + moving * early[:, at.SPAN] ** 2 * early[:, at.BIAS_VARIANCE]
    turn = np.concatenate([turn[0] + np.cumsum(slip[::-1])[::-1], turn])
    variance = np.concatenate([variance[0] + np.cumsum(spread[::-1])[::-1], variance])
    return turn, variance


def _transitions(rows: FloatArray, model: FieldModel, states: FloatArray) -> FloatArray:
    """Transition to each bin from the one before, shape (n, STATES, STATES)."""
    steps = np.tile(np.eye(at.STATES), (len(rows), 1, 1))
    span, moving = rows[:, at.SPAN], rows[:, at.RESTS] == 0.0
    keep = np.exp(-span / BIAS_S)
    fade = np.where(moving, np.exp(-span / model.stray_s), 1.0)
    stays = np.concatenate([[1.0], rows[1:, at.RESTS] == rows[:-1, at.RESTS]])
    across, along = np.vstack([states[:1], states[:-1]])[:, at.OF_ROOM : at.OF_ROOM + 2].T
    for i in range(3):
        rate = rows[:, at.POSE + 6 + i] * span * keep * moving
        steps[:, at.GYRO_BIAS + i, at.GYRO_BIAS + i] = keep
        steps[:, at.OF_ROOM, at.GYRO_BIAS + i] = -rate * along
        steps[:, at.OF_ROOM + 1, at.GYRO_BIAS + i] = rate * across
        steps[:, at.OF_STRAY + i, at.OF_STRAY + i] = fade
        steps[:, at.OF_PLACE + i, at.OF_PLACE + i] = stays
    return steps
