"""Inclination step by step, with NumPy and SciPy's rotations: what the kernels are held against."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import skew
from speckle3d.kernels.orientation.inclination import SHOCK_M_S2
from xsens.fusion import inclination as constants
from xsens.fusion.inclination import fresh_filter
from xsens.fusion.samples import Samples
from xsens.fusion.settings import LOST, FusionSettings

_CHUNK = 64
"""Increments summed with one bias, about two seconds; its later change is corrected to first order."""

ANGLE, BIAS, SPEED = slice(0, 3), slice(3, 6), slice(6, 9)
HEADING = 2
UP = np.array([0.0, 0.0, 1.0])


# -- increments


@dataclass(frozen=True)
class Increment:
    """Sums over the samples of an increment, in the sensor's axes at its start.

    Attributes
    ----------
    duration_s : float
    turns : Rotation, a row per sample
        Start from each sample, by the gyroscope less `assumed`.
    time_s : ndarray, shape (samples,)
        Since the start.
    assumed : ndarray, shape (3,)
        The gyroscope's bias, rad/s.
    push, rate, field : ndarray, shape (3,)
        Integral of the specific force, mean reading of the gyroscope, mean field (NaN if there is none).
    bridged : float
        Variance of the turn over lost samples, rad^2.
    """

    duration_s: float
    turns: Rotation
    time_s: FloatArray
    assumed: FloatArray
    push: FloatArray
    rate: FloatArray
    field: FloatArray
    bridged: float

    @property
    def turn(self) -> Rotation:
        """Start from end."""
        return self.turns[-1]


def summed(samples: Samples, first: int, end: int, assumed: FloatArray, before: FloatArray) -> Increment:
    """Sum samples with that bias; the specific force is read halfway through each sample's turn."""
    changes = np.diff(samples.rate_rad_s, axis=0, prepend=before)
    lost = samples.step_s > LOST * np.median(samples.step_s)
    bridged = ((changes * samples.step_s[:, None]) ** 2).sum(axis=1)[first:end] @ lost[first:end]
    samples = samples[first:end]
    each = Rotation.from_rotvec((samples.rate_rad_s - assumed) * samples.step_s[:, None])
    turns = [each[0]]
    for one in each[1:]:
        turns.append(turns[-1] * one)
    ends = Rotation.concatenate(turns)
    pushes = (ends * (each**0.5).inv()).apply(samples.force_m_s2) * samples.step_s[:, None]
    fields = ends.apply(samples.field_au)
    fields = fields[np.isfinite(fields).all(axis=1)]
    return Increment(
        samples.step_s.sum(),
        ends,
        np.cumsum(samples.step_s),
        assumed,
        pushes.sum(axis=0),
        np.average(samples.rate_rad_s, axis=0, weights=samples.step_s),
        fields.mean(axis=0) if len(fields) else np.full(3, np.nan),
        bridged,
    )


def upright(force: FloatArray) -> Rotation:
    """The shortest rotation that takes `force` to up."""
    axis = np.cross(force, UP)
    angle = math.atan2(np.linalg.norm(axis), force[2])
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))


# -- forward


@dataclass(frozen=True)
class Step:
    """The filter before and after an increment; rotations are world from sensor.

    Attributes
    ----------
    increment : Increment
    start, predicted, after : Rotation
        Before the increment, after it, and after its correction.
    start_bias, bias : ndarray, shape (3,)
    predicted_speed, speed : ndarray, shape (3,)
    covariance, transition, noise : ndarray, shape (9, 9)
    resting, started : bool
    """

    increment: Increment
    start: Rotation
    predicted: Rotation
    after: Rotation
    start_bias: FloatArray
    bias: FloatArray
    predicted_speed: FloatArray
    speed: FloatArray
    covariance: FloatArray
    transition: FloatArray
    noise: FloatArray
    resting: bool
    started: bool


class LevelFilter:
    """Error-state filter: attitude (world axes), the gyroscope's bias (sensor axes), velocity (world axes).

    The attitude's error turns the velocity too (the invariant error). A velocity of zero corrects neither
    heading nor the bias about up; with `heading_apart` nothing corrects the heading.
    """

    def __init__(self, settings: FusionSettings, heading_apart: bool = False) -> None:
        self.settings, self.heading_apart = settings, heading_apart
        self.p = fresh_filter(settings).fresh
        self.level, self.speed, self.bias = Rotation.identity(), np.zeros(3), np.zeros(3)

    def run(self, samples: Samples, last: FloatArray, pause_s: float | None) -> list[Step]:
        """Run over a stretch whose increments end before the samples `last`; no pause: it goes on."""
        steps = []
        before = samples.rate_rad_s[:1] if pause_s is not None else self.last_rate
        self.last_rate = samples.rate_rad_s[-1:]
        edges = list(pairwise([0, *last]))
        for n, (first, end) in enumerate(edges):
            left_over = n == len(edges) - 1 and end - first != last[0]
            if n % _CHUNK == 0 or left_over:
                assumed = self.bias
            increment = summed(samples, first, end, assumed, before)
            if n == 0 and pause_s is not None:
                self._set_up(increment, pause_s)
            steps.append(self._advance(increment))
        return steps

    def _set_up(self, increment: Increment, pause_s: float) -> None:
        fresh = fresh_filter(self.settings).fresh
        if hasattr(self, "starting"):
            walk = self.settings.bias_walk_rad_s_sqrt_s**2 * pause_s
            fresh[BIAS, BIAS] = self.p[BIAS, BIAS] + walk * np.eye(3)
        self.p, self.starting, self.still_s = fresh, True, 0.0
        self.level, self.speed = upright(increment.push), np.zeros(3)
        self.start_push, self.start_turn, self.start_s = np.zeros(3), self.level, 0.0
        self.mean_rate, self.mean_force = increment.rate, increment.push / increment.duration_s

    def _advance(self, increment: Increment) -> Step:
        start, start_bias = self.level, self.bias
        resting = self._rests(increment)
        transition, noise = self._model(increment, resting)
        self.p = transition @ self.p @ transition.T + noise
        self.speed = self.speed + start.apply(increment.push)
        self.speed = self.speed - self.settings.gravity_m_s2 * increment.duration_s * UP
        if not resting:
            late = Rotation.from_rotvec((increment.assumed - self.bias) * increment.duration_s)
            self.level = start * increment.turn * late
        predicted, predicted_speed = self.level, self.speed
        if self.starting:
            self._begin(increment)
        else:
            self._speed_is_zero(increment.duration_s, resting)
            if resting:
                variance = constants.REST_BIAS_RAD**2 / increment.duration_s
                self._correct(BIAS, increment.rate - self.bias, variance, self.heading_apart)
        return Step(
            increment,
            start,
            predicted,
            self.level,
            start_bias,
            self.bias,
            predicted_speed,
            self.speed,
            self.p,
            transition,
            noise,
            resting,
            not self.starting,
        )

    def _rests(self, increment: Increment) -> bool:
        s, duration = self.settings, increment.duration_s
        share = duration / (constants.REST_MEMORY_S + duration)
        rate_off = increment.rate - self.mean_rate
        force_off = increment.push / duration - self.mean_force
        self.mean_rate = self.mean_rate + share * rate_off
        self.mean_force = self.mean_force + share * force_off
        bias_off = np.linalg.norm(self.mean_rate - self.bias)
        bias_sd = math.sqrt(np.diag(self.p)[BIAS].max())
        still = np.linalg.norm(rate_off) < s.rest_rate_rad_s and np.linalg.norm(force_off) < s.rest_force_m_s2
        still = still and bias_off < s.rest_bias_rad_s + 3.0 * bias_sd
        self.still_s = self.still_s + duration if still else 0.0
        return bool(self.still_s > s.rest_after_s)

    def _model(self, increment: Increment, resting: bool) -> tuple[FloatArray, FloatArray]:
        """Transition and noise."""
        s, duration = self.settings, increment.duration_s
        transition = np.eye(9)
        transition[SPEED, ANGLE] = skew(-s.gravity_m_s2 * duration * UP)
        turning = (constants.REST_NOISE * s.gyro_noise_rad_sqrt_s) ** 2
        if not resting:
            turns = self.level.as_matrix() * duration
            transition[ANGLE, BIAS], transition[SPEED, BIAS] = -turns, -skew(self.speed) @ turns
            rate = np.linalg.norm(increment.rate - self.bias)
            turning = s.gyro_noise_rad_sqrt_s**2 + (s.gyro_scale_noise_sqrt_s * rate) ** 2
        each = [turning, s.bias_walk_rad_s_sqrt_s**2, s.force_noise_m_s_sqrt_s**2]
        noise = np.diag(np.repeat(each, 3)) * duration
        noise[ANGLE, ANGLE] += increment.bridged * np.eye(3)
        beyond = np.linalg.norm(increment.push) - SHOCK_M_S2 * duration
        noise[SPEED, SPEED] += max(beyond, 0.0) ** 2 * np.eye(3)
        return transition, noise

    def _begin(self, increment: Increment) -> None:
        """The level is that of the mean force since the start."""
        self.start_push = self.start_push + self.start_turn.apply(increment.push)
        self.start_turn = self.start_turn * increment.turn
        self.start_s += increment.duration_s
        self.level, self.speed = upright(self.start_push) * self.start_turn, np.zeros(3)
        still = self.still_s > 0.5 * constants.START_S
        self.starting = self.start_s < (constants.START_S if still else constants.MOVING_START_S)

    def _speed_is_zero(self, duration_s: float, resting: bool) -> None:
        s = self.settings
        variance = 2.0 * s.speed_m_s**2 * s.speed_time_s
        if resting:
            variance = 2.0 * constants.REST_SPEED_M_S**2 * constants.REST_TIME_S
        self._correct(SPEED, -self.speed, variance / duration_s, heading_apart=True, about_up=True)

    def _correct(
        self,
        shown: slice,
        residual: FloatArray,
        variance: float,
        heading_apart: bool,
        about_up: bool = False,
    ) -> None:
        """Correct by a reading of three states; what is left uncorrected counts as noise (Schmidt)."""
        shows, noise = np.eye(9)[shown], variance * np.eye(3)
        gain = self.p @ shows.T @ np.linalg.inv(shows @ self.p @ shows.T + noise)
        if heading_apart:
            gain[HEADING] = 0.0
        if about_up:
            up = self.level.inv().apply(UP)
            gain[BIAS] -= np.outer(up, up) @ gain[BIAS]
        keep = np.eye(9) - gain @ shows
        self.p = keep @ self.p @ keep.T + gain @ noise @ gain.T
        error = gain @ residual
        turn = Rotation.from_rotvec(error[ANGLE])
        self.level, self.bias = turn * self.level, self.bias + error[BIAS]
        self.speed = turn.apply(self.speed) + error[SPEED]


# -- backward


@dataclass(frozen=True)
class Smoothed:
    """Smoothed orientation at the start and at the end of each of n steps.

    Attributes
    ----------
    matrices : ndarray, shape (n + 1, 3, 3)
    bias, sd, bias_sd : ndarray, shape (n + 1, 3)
    """

    matrices: FloatArray
    bias: FloatArray
    sd: FloatArray
    bias_sd: FloatArray


def smoothed(steps: list[Step]) -> Smoothed:
    """Smooth since the filter started (Rauch, Tung, Striebel); before, go back by the gyroscope."""
    first = next(k for k, step in enumerate(steps) if step.started)
    level, bias, speed, p = steps[-1].after, steps[-1].bias, steps[-1].speed, steps[-1].covariance
    nodes = [(level, bias, p)]
    for step, after in reversed(list(pairwise(steps[first:]))):
        expected = after.transition @ step.covariance @ after.transition.T + after.noise
        gain = step.covariance @ after.transition.T @ np.linalg.inv(expected)
        turned = level * after.predicted.inv()
        off = [turned.as_rotvec(), bias - step.bias, speed - turned.apply(after.predicted_speed)]
        error = gain @ np.concatenate(off)
        turn = Rotation.from_rotvec(error[ANGLE])
        level, bias = turn * step.after, step.bias + error[BIAS]
        speed = turn.apply(step.speed) + error[SPEED]
        p = step.covariance + gain @ (p - expected) @ gain.T
        nodes.append((level, bias, p))
    for step in reversed(steps[: first + 1]):
        if not step.resting:
            late = Rotation.from_rotvec((step.increment.assumed - bias) * step.increment.duration_s)
            level = level * (step.increment.turn * late).inv()
        nodes.append((level, bias, p))
    levels, biases, covariances = zip(*nodes[::-1], strict=True)
    sd = np.sqrt(np.diagonal(np.array(covariances), axis1=1, axis2=2))
    return Smoothed(Rotation.concatenate(levels).as_matrix(), np.array(biases), sd[:, ANGLE], sd[:, BIAS])
