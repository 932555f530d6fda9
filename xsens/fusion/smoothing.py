"""Back over a recorded stretch: every orientation from what came before it and after.

Inclination and turning come first, without the magnetometer, by a Rauch-Tung-Striebel pass over the filter's
steps. Then the heading's offset from north, one number that wanders as slowly as the gyroscope allows, is
smoothed over the field seen from those orientations. So iron cannot tilt the answer here either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from xsens.fusion.disturbance import FieldMonitor, FieldReading
from xsens.fusion.errorstate import ANGLE, BIAS, HEADING, SPEED
from xsens.fusion.forward import Pass, Step, forward
from xsens.fusion.increments import Samples
from xsens.fusion.quaternions import turn_matrix
from xsens.fusion.settings import FusionSettings

_STATES = 9
"""Attitude, bias and velocity: without the magnetometer there is one bias."""

_FIRST_S = 1.0
"""The first heading is the mean of so long, as in the filter."""


@dataclass(frozen=True)
class Smoothed:
    """A stretch at the ends of its steps, preceded by its start.

    Attributes
    ----------
    matrices : ndarray, shape (steps + 1, 3, 3)
        World from sensor.
    bias_rad_s : ndarray, shape (steps + 1, 3)
    sd_rad : ndarray, shape (steps + 1, 3)
        About the world's axes.
    disturbed, resting : ndarray of bool, shape (steps,)
    """

    matrices: FloatArray
    bias_rad_s: FloatArray
    sd_rad: FloatArray
    disturbed: BoolArray
    resting: BoolArray


def smooth(samples: Samples, settings: FusionSettings) -> tuple[Pass, Smoothed]:
    """Smooth one stretch; its length must exceed the filter's start, one second."""
    done, _ = forward(samples, replace(settings, use_magnetometer=False))
    level = _backward(done.steps)
    if not settings.use_magnetometer:
        return done, level
    return done, _pointed_north(done.steps, level, settings)


# -- inclination and turning


def _backward(steps: list[Step]) -> Smoothed:
    """Rauch-Tung-Striebel over the steps since the filter started, then by the gyroscope to the beginning."""
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
    """Go on backward by the gyroscope alone through the steps in which the filter started."""
    for step in reversed(steps):
        increment = step.increment
        matrices_after, bias = matrices[-1], biases[-1]
        turn = increment.turn @ turn_matrix((increment.bias_rad_s - bias) * increment.duration_s)
        matrices.append(matrices_after if step.resting else matrices_after @ turn.T)
        biases.append(bias)


# -- heading


def _pointed_north(steps: list[Step], level: Smoothed, settings: FusionSettings) -> Smoothed:
    """Turn a smoothed stretch to magnetic north, by the field along it."""
    readings = _readings(steps, level, settings)
    if all(reading is None for reading in readings):
        return level
    offset, variance = _smoothed_heading(steps, level, readings, settings)
    turns = Rotation.from_euler("z", offset[:, None]).as_matrix()
    sd = np.column_stack([level.sd_rad[:, :HEADING], np.sqrt(np.maximum(variance, 0.0))])
    disturbed = np.array([reading is not None and reading.disturbed for reading in readings])
    return replace(level, matrices=turns @ level.matrices, sd_rad=sd, disturbed=disturbed)


def _readings(steps: list[Step], level: Smoothed, settings: FusionSettings) -> list[FieldReading | None]:
    """The field at every step, judged forward and backward in time: the better of both judgements."""
    forward_readings = _judged(steps, level, settings, range(len(steps)))
    backward_readings = _judged(steps, level, settings, range(len(steps) - 1, -1, -1))
    return [_better(a, b) for a, b in zip(forward_readings, backward_readings, strict=True)]


def _judged(
    steps: list[Step], level: Smoothed, settings: FusionSettings, order: range
) -> list[FieldReading | None]:
    """Judgements in one direction; a first reference that did not prove itself is taken back."""
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
    """Angle about up that takes the smoothed stretch to north at every node, and its variance, (steps + 1,).

    State: the angle, and what the bias is still off by (sensor axes).
    """
    kalman = KalmanFilter(dim_x=5, dim_z=1)
    kalman.x[0, 0] = _first_angle(steps, readings)
    kalman.P = np.diag([math.pi**2, *_bias_variances(steps), settings.field_sd_rad**2])
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


def _bias_variances(steps: list[Step]) -> FloatArray:
    """What is left of the bias's variance when the stretch is over."""
    return np.diag(steps[-1].covariance)[BIAS]


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
    """Variance of a reading: the field's unevenness in a place, iron that shows, the inclination's share."""
    x, y, z = reading.world_au
    steepness = z * z / max(x * x + y * y, 1e-12)
    tilt = steepness * (sd_rad[0] ** 2 + sd_rad[1] ** 2) / 2.0
    off = 2.0 * settings.field_off_s * (reading.variance_rad2 + tilt)
    return float((settings.field_noise_rad_sqrt_s**2 + off) / step.increment.duration_s)
