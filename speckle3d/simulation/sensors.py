"""Sensors that ride on the simulated probe, each on its own clock, with its own errors."""

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.simulation.movement import Movement

TRACKER_FROM_IMAGE = RigidTransform.from_components(
    [12.0, -85.0, 23.0], Rotation.from_euler("ZYX", [0.35, -0.8, 1.9])
)
"""Where the image is on the tracker's sensor."""
_LATENCY_S = 0.04
_JITTER_MM, _JITTER_RAD = 0.15, np.deg2rad(0.1)
"""Of the tracker: standard deviation per axis, white from sample to sample."""

ORIENTATION_FROM_IMAGE = Rotation.from_euler("ZYX", [1.2, 0.4, -0.7])
"""How the image is turned on the orientation sensor, an MT9-B."""
LEVER_MM = np.array([19.0, -110.0, 8.0])
"""Its place in the image frame: the accelerometer feels the probe turn."""
_OFFSET_S = -0.012
_SLOW_RAD = np.deg2rad([0.15, 0.15, 0.5])
_WANDER_S = 40.0
"""Slow errors of roll, pitch and heading: up to two tenths of a degree over a sweep of seconds."""
_WHITE_RAD = np.deg2rad(0.03)
"""Noise of each orientation sample, as measured on static logs at 256 Hz."""
_GYROSCOPE_RAD_S = np.deg2rad([0.3, 0.6])
_ACCELEROMETER_M_S2 = (0.03, 0.015)
_MAGNETOMETER_AU = (0.0, 0.004)
"""Biases, which are drawn once per sweep, and white noise per raw sample."""
_DIP_RAD = np.deg2rad(66.0)
"""The earth's field points north and this much down; its strength is one."""

_GRAVITY_M_S2 = np.array([0.0, 0.0, 9.81])
_DERIVATIVE_S = 1e-3
"""Half-width of central differences: short against a tremor's period of 80 ms, long against rounding."""


def simulate_tracker(
    trajectory: Movement, span_s: tuple[float, float], rng: Generator, noise: float = 1.0
) -> Tracker:
    """Track the probe over `span_s` of image time; `noise` multiplies all errors but the clock's.

    The reading stamped t on the sensor's clock shows the probe at ``t - latency``.
    """
    clock = _clock(span_s, 50.0, 5e-4, rng)
    rng.random(clock.size)  # once for dropouts; what follows keeps its numbers
    true = trajectory.world_from_image(clock) * TRACKER_FROM_IMAGE.inv()
    jitter = Rotation.from_rotvec(noise * _JITTER_RAD * rng.standard_normal((clock.size, 3)))
    place = true.translation + noise * _JITTER_MM * rng.standard_normal((clock.size, 3))
    readings = TimedPoses(clock + _LATENCY_S, RigidTransform.from_components(place, true.rotation * jitter))
    return Tracker(readings, TRACKER_FROM_IMAGE, -_LATENCY_S)


def simulate_orientation(
    trajectory: Movement, span_s: tuple[float, float], rng: Generator, noise: float = 1.0
) -> OrientationSensor:
    """Orientation and raw inertial readings over `span_s` of image time; `noise` as of the tracker."""
    clock = _clock(span_s, 100.0, 1e-4, rng)
    poses = [trajectory.world_from_image(clock + shift) for shift in (-_DERIVATIVE_S, 0.0, _DERIVATIVE_S)]
    before, rotation, after = (pose.rotation * ORIENTATION_FROM_IMAGE.inv() for pose in poses)
    path = [pose.apply(LEVER_MM) for pose in poses]
    wander = _wander(clock, rng) * (noise * _SLOW_RAD)
    white = Rotation.from_rotvec(noise * _WHITE_RAD * rng.standard_normal((clock.size, 3)))
    readings = Rotation.from_rotvec(wander) * rotation * white
    # At rest the specific force, acceleration minus gravity, points up.
    acceleration = 1e-3 * (path[0] - 2.0 * path[1] + path[2]) / _DERIVATIVE_S**2
    force = rotation.inv().apply(acceleration + _GRAVITY_M_S2)
    rate = (before.inv() * after).as_rotvec() / (2.0 * _DERIVATIVE_S)
    field = rotation.inv().apply([np.cos(_DIP_RAD), 0.0, -np.sin(_DIP_RAD)])

    def noisy(true: FloatArray, bias: float, white: float) -> FloatArray:
        level = true + noise * bias * rng.standard_normal(3)
        return level + noise * white * rng.standard_normal(true.shape)

    return OrientationSensor(
        TimedRotations(clock - _OFFSET_S, readings),
        ORIENTATION_FROM_IMAGE,
        _OFFSET_S,
        noisy(force, *_ACCELEROMETER_M_S2),
        noisy(rate, *_GYROSCOPE_RAD_S),
        noisy(field, *_MAGNETOMETER_AU),
    )


def _clock(span_s: tuple[float, float], rate_hz: float, jitter_s: float, rng: Generator) -> FloatArray:
    first = span_s[0] + rng.uniform(0.0, 1.0 / rate_hz)
    n = int((span_s[1] - first) * rate_hz)
    return first + np.arange(n) / rate_hz + rng.uniform(-jitter_s, jitter_s, n)


def _wander(time_s: FloatArray, rng: Generator) -> FloatArray:
    """First-order random wander of unit standard deviation in three axes, shape (m, 3)."""
    keep = np.exp(-np.diff(time_s) / _WANDER_S)
    out = rng.standard_normal((time_s.size, 3))
    for i, k in enumerate(keep, start=1):
        out[i] = k * out[i - 1] + np.sqrt(1.0 - k * k) * out[i]
    return out
