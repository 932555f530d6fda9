"""Filter and smoother of recordings step by step, with filterpy: what the kernels are held against."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.spatial.transform import Rotation
from xsens.fusion.detectors import FieldMonitor, FieldReading
from xsens.fusion.errorstate import ANGLE, BIAS, HEADING, SPEED, ErrorStateFilter
from xsens.fusion.increments import Increment, Samples, increments_of, turn_matrix
from xsens.fusion.smoothing import Smoothed

from speckle3d.core.arrays import FloatArray
from xsens.fusion.settings import FusionSettings

_CHUNK = 64
"""Blocks summed with one bias, about two seconds; its later change is corrected to first order."""

_STATES = 9
"""Attitude, bias and velocity: without the magnetometer there is one bias."""

_FIRST_S = 1.0
"""The first heading is the mean over this time, as in the filter."""


# -- forward


@dataclass(frozen=True)
class Step:
    """State of the filter before and after one increment; matrices are world from sensor.

    Attributes
    ----------
    increment : Increment
    start : ndarray, shape (3, 3)
        Orientation before the increment.
    start_bias_rad_s : ndarray, shape (3,)
    predicted, predicted_velocity_m_s : ndarray, shapes (3, 3) and (3,)
        After the increment, before the correction.
    matrix, velocity_m_s, bias_rad_s : ndarray, shapes (3, 3), (3,) and (3,)
        After the correction.
    covariance : ndarray, shape (13, 13)
        After the correction.
    transition, noise : ndarray, shape (13, 13)
        Of the prediction.
    resting, disturbed, started : bool
    """

    increment: Increment
    start: FloatArray
    start_bias_rad_s: FloatArray
    predicted: FloatArray
    predicted_velocity_m_s: FloatArray
    matrix: FloatArray
    velocity_m_s: FloatArray
    bias_rad_s: FloatArray
    covariance: FloatArray
    transition: FloatArray
    noise: FloatArray
    resting: bool
    disturbed: bool
    started: bool


def forward(
    samples: Samples, settings: FusionSettings, kept: ErrorStateFilter | None = None, pause_s: float = 0.0
) -> tuple[list[Step], ErrorStateFilter]:
    """Run the filter over a stretch.

    Parameters
    ----------
    samples : Samples
        One stretch without a pause.
    settings : FusionSettings
    kept : ErrorStateFilter, optional
        The filter at the end of the stretch before, to be continued.
    pause_s : float
        Time since the end of that stretch.
    """
    steps: list[Step] = []
    kalman = kept
    for part, per_block in _parts(samples, settings):
        bias = np.zeros(3) if kalman is None else kalman.bias
        for increment in increments_of(part, per_block, bias):
            if kalman is None:
                kalman = ErrorStateFilter(settings, increment)
            elif not steps:
                kalman.resume(increment, pause_s)
            steps.append(_step(kalman, increment))
    assert kalman is not None
    return steps, kalman


def _parts(samples: Samples, settings: FusionSettings) -> Iterator[tuple[Samples, int]]:
    """Runs of whole blocks, then the remaining samples as one block, with the samples per block."""
    per_block = max(1, round(settings.block_s / float(np.median(samples.step_s))))
    whole = len(samples) // per_block * per_block
    for first in range(0, whole, _CHUNK * per_block):
        yield samples[first : min(first + _CHUNK * per_block, whole)], per_block
    if whole < len(samples):
        yield samples[whole:], len(samples) - whole


def _step(kalman: ErrorStateFilter, increment: Increment) -> Step:
    start, bias = kalman.matrix, kalman.heading_bias
    kalman.advance(increment)
    predicted, velocity = kalman.predicted
    return Step(
        increment=increment,
        start=start,
        start_bias_rad_s=bias,
        predicted=predicted,
        predicted_velocity_m_s=velocity,
        matrix=kalman.matrix,
        velocity_m_s=kalman.velocity,
        bias_rad_s=kalman.heading_bias,
        covariance=kalman.kalman.P,
        transition=kalman.transition,
        noise=kalman.noise,
        resting=kalman.resting,
        disturbed=kalman.disturbed,
        started=kalman.started,
    )


# -- backward


def smooth(samples: Samples, settings: FusionSettings) -> tuple[list[Step], Smoothed]:
    """Smooth one stretch, which must be longer than the filter's start, one second."""
    steps, _ = forward(samples, replace(settings, use_magnetometer=False))
    level = _backward(steps)
    return steps, _pointed_north(steps, level, settings) if settings.use_magnetometer else level


# -- inclination and turning


def _backward(steps: list[Step]) -> Smoothed:
    """Smooth the steps since the filter started (Rauch-Tung-Striebel); before, go back by the gyroscope."""
    first = next(k for k, step in enumerate(steps) if step.started)
    used = steps[first:]
    gains, covariances = _gains(used)
    matrices, biases = [used[-1].matrix], [used[-1].bias_rad_s]
    velocity = used[-1].velocity_m_s
    for k in range(len(used) - 2, -1, -1):
        step, after = used[k], used[k + 1]
        turned = Rotation.from_matrix(matrices[-1] @ after.predicted.T)
        off = np.empty(_STATES)
        off[ANGLE] = turned.as_rotvec()
        off[BIAS] = biases[-1] - step.bias_rad_s
        off[SPEED] = velocity - turned.apply(after.predicted_velocity_m_s)
        error = gains[k] @ off
        turn = turn_matrix(error[ANGLE])
        matrices.append(turn @ step.matrix)
        biases.append(step.bias_rad_s + error[BIAS])
        velocity = turn @ step.velocity_m_s + error[SPEED]
    _begin(steps[: first + 1], matrices, biases)
    sd = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2)[:, ANGLE], 0.0))
    sd = np.concatenate([np.repeat(sd[:1], first + 1, axis=0), sd])
    resting = np.array([step.resting for step in steps])
    undisturbed = np.zeros(len(steps), dtype=bool)
    return Smoothed(np.array(matrices[::-1]), np.array(biases[::-1]), sd, undisturbed, resting)


def _gains(steps: list[Step]) -> tuple[FloatArray, FloatArray]:
    """Smoother gains and smoothed covariances, shape (steps, 9, 9)."""
    part = slice(0, _STATES)
    covariances = np.array([step.covariance[part, part] for step in steps])
    transitions = [step.transition[part, part] for step in steps]
    noises = [step.noise[part, part] for step in steps]
    smoother = KalmanFilter(dim_x=_STATES, dim_z=3)
    zero = np.zeros((len(steps), _STATES))
    _, smoothed, gains, _ = smoother.rts_smoother(zero, covariances, transitions, noises)
    return gains, smoothed


def _begin(steps: list[Step], matrices: list[FloatArray], biases: list[FloatArray]) -> None:
    """Extend backward by the gyroscope alone through the steps in which the filter started."""
    for step in reversed(steps):
        increment = step.increment
        matrices_after, bias = matrices[-1], biases[-1]
        turn = increment.turn @ turn_matrix((increment.bias_rad_s - bias) * increment.duration_s)
        matrices.append(matrices_after if step.resting else matrices_after @ turn.T)
        biases.append(bias)


# -- heading


def _pointed_north(steps: list[Step], level: Smoothed, settings: FusionSettings) -> Smoothed:
    """Turn a smoothed stretch to magnetic north by the field along it."""
    readings = _readings(steps, level, settings)
    if all(reading is None for reading in readings):
        return level
    offset, variance = _smoothed_heading(steps, level, readings, settings)
    turns = Rotation.from_euler("z", offset[:, None]).as_matrix()
    sd = np.column_stack([level.sd_rad[:, :HEADING], np.sqrt(np.maximum(variance, 0.0))])
    disturbed = np.array([reading is not None and reading.disturbed for reading in readings])
    return replace(level, matrices=turns @ level.matrices, sd_rad=sd, disturbed=disturbed)


def _readings(steps: list[Step], level: Smoothed, settings: FusionSettings) -> list[FieldReading | None]:
    """Field at every step, judged forward and backward in time; the better judgement of the two."""
    forward_readings = _judged(steps, level, settings, range(len(steps)))
    backward_readings = _judged(steps, level, settings, range(len(steps) - 1, -1, -1))
    return [_better(a, b) for a, b in zip(forward_readings, backward_readings, strict=True)]


def _judged(
    steps: list[Step], level: Smoothed, settings: FusionSettings, order: range
) -> list[FieldReading | None]:
    """Judge the field in one direction of time; steps judged by a wrong first reference are judged again."""
    monitor = FieldMonitor(settings)
    readings: list[FieldReading | None] = [None] * len(steps)
    wrong = 0
    for seen, k in enumerate(order):
        reading = readings[k] = _read(monitor, steps[k], level, k)
        if reading is not None and reading.restart_au is not None:
            wrong = seen
    for k in reversed(order[:wrong]):
        readings[k] = _read(monitor, steps[k], level, k)
    return readings


def _read(monitor: FieldMonitor, step: Step, level: Smoothed, k: int) -> FieldReading | None:
    increment = step.increment
    if increment.field_au is None:
        return None
    rate = increment.rate_rad_s - level.bias_rad_s[k]
    middle = level.matrices[k] @ turn_matrix(0.5 * rate * increment.duration_s)
    field = level.matrices[k] @ increment.field_au
    return monitor.read(middle, field, math.hypot(*rate), increment.duration_s)


def _better(a: FieldReading | None, b: FieldReading | None) -> FieldReading | None:
    if a is None or b is None:
        return a or b
    return min(a, b, key=lambda reading: (reading.disturbed, reading.variance_rad2))


def _smoothed_heading(
    steps: list[Step], level: Smoothed, readings: list[FieldReading | None], settings: FusionSettings
) -> tuple[FloatArray, FloatArray]:
    """Angle about up that turns the smoothed stretch to north, and its variance, each shape (steps + 1,).

    State, 5: the angle, the remaining error of the bias (sensor axes), and the field's own stray.
    """
    kalman = KalmanFilter(dim_x=5, dim_z=1)
    kalman.x[0, 0] = _first_angle(steps, readings)
    bias_variance = np.diag(steps[-1].covariance)[BIAS]  # at the end of the stretch
    kalman.P = np.diag([math.pi**2, *bias_variance, settings.field_sd_rad**2])
    shows = np.array([[1.0, 0.0, 0.0, 0.0, 1.0]])
    nodes, transitions, noises = [(kalman.x, kalman.P)], [np.eye(5)], [np.zeros((5, 5))]
    for k, (step, reading) in enumerate(zip(steps, readings, strict=True)):
        transition, noise = _heading_model(step, level.matrices[k], settings)
        kalman.predict(F=transition, Q=noise)
        if reading is not None and not reading.disturbed:
            shown = float(kalman.x[0, 0] + kalman.x[4, 0])
            turned = math.remainder(_north(reading) - shown, 2.0 * math.pi)
            variance = _heading_variance(step, reading, level.sd_rad[k + 1], settings)
            kalman.update(np.array([[shown + turned]]), R=variance, H=shows)
        nodes.append((kalman.x, kalman.P))
        transitions.append(transition)
        noises.append(noise)
    means, covariances = np.array([x for x, _ in nodes]), np.array([p for _, p in nodes])
    angle, covariance, _, _ = kalman.rts_smoother(means, covariances, transitions, noises)
    return angle[:, 0, 0], covariance[:, 0, 0]


def _north(reading: FieldReading) -> float:
    return -math.atan2(reading.world_au[1], reading.world_au[0])


def _first_angle(steps: list[Step], readings: list[FieldReading | None]) -> float:
    """Mean heading of the first second of trusted field."""
    total, spent = 0.0 + 0.0j, 0.0
    for step, reading in zip(steps, readings, strict=True):
        if reading is not None and not reading.disturbed and spent < _FIRST_S:
            total += np.exp(1j * _north(reading))
            spent += step.increment.duration_s
    return float(np.angle(total))


def _heading_model(step: Step, matrix: FloatArray, settings: FusionSettings) -> tuple[FloatArray, FloatArray]:
    transition, noise = np.eye(5), np.zeros((5, 5))
    duration = step.increment.duration_s
    if not step.resting:
        transition[0, 1:4] = -matrix[HEADING] * duration
        transition[4, 4] = 1.0 - duration / settings.field_place_s
        noise[4, 4] = 2.0 * settings.field_sd_rad**2 / settings.field_place_s * duration
    noise[0, 0] = step.noise[HEADING, HEADING]
    noise[1:4, 1:4] = step.noise[BIAS, BIAS]
    return transition, noise


def _heading_variance(
    step: Step, reading: FieldReading, sd_rad: FloatArray, settings: FusionSettings
) -> float:
    """Variance of a heading reading: unevenness of the field, visible iron, error of the inclination."""
    x, y, z = reading.world_au
    steepness = z * z / max(x * x + y * y, 1e-12)
    tilt = steepness * (sd_rad[0] ** 2 + sd_rad[1] ** 2) / 2.0
    off = 2.0 * settings.field_off_s * (reading.variance_rad2 + tilt)
    return float((settings.field_noise_rad_sqrt_s**2 + off) / step.increment.duration_s)
