"""Sensors that ride on the simulated probe, each on its own clock, with its own errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.streams import TimedPoses, TimedRotations
from speckle3d.core.sweep import OrientationSensor, Tracker
from speckle3d.simulation.movement import Trajectory

GRAVITY_M_S2 = 9.81

_DERIVATIVE_S = 1e-3
"""Half-width of central differences: short against a tremor's period of 80 ms, long against rounding."""


@dataclass(frozen=True)
class TrackerModel:
    """A 6-DOF position sensor. Jitter is the standard deviation per axis, white from sample to sample."""

    rate_hz: float = 50.0
    clock_jitter_s: float = 5e-4
    position_mm: float = 0.15
    orientation_rad: float = np.deg2rad(0.1)
    latency_s: float = 0.04
    dropouts: float = 0.0
    mounting_rad: tuple[float, float, float] = (0.35, -0.8, 1.9)
    mounting_mm: tuple[float, float, float] = (12.0, -85.0, 23.0)

    @property
    def sensor_from_image(self) -> RigidTransform:
        """Where the image is on the sensor."""
        return RigidTransform.from_components(self.mounting_mm, Rotation.from_euler("ZYX", self.mounting_rad))


@dataclass(frozen=True)
class OrientationModel:
    """An MT9-B: white noise as measured on static logs at 256 Hz, and slowly wandering errors.

    Parameters
    ----------
    inclination_rad, heading_rad : float
        Slow error of roll and pitch, and of heading, wandering with `wander_s` (a few hundredths to two
        tenths of a degree over a sweep of seconds).
    white_rad : float
        Noise of each orientation sample.
    gyroscope_rad_s, accelerometer_m_s2, magnetometer_au : float
        White noise per raw sample; the biases are drawn once per sweep.
    dip_rad : float
        The earth's field points north and this much down; its strength is one.
    lever_mm : tuple of float
        The sensor's place in the image frame: the accelerometer feels the probe turn.
    """

    rate_hz: float = 100.0
    clock_jitter_s: float = 1e-4
    inclination_rad: float = np.deg2rad(0.15)
    heading_rad: float = np.deg2rad(0.5)
    wander_s: float = 40.0
    white_rad: float = np.deg2rad(0.03)
    gyroscope_rad_s: float = np.deg2rad(0.6)
    gyroscope_bias_rad_s: float = np.deg2rad(0.3)
    accelerometer_m_s2: float = 0.015
    accelerometer_bias_m_s2: float = 0.03
    magnetometer_au: float = 0.004
    dip_rad: float = np.deg2rad(66.0)
    time_offset_s: float = -0.012
    mounting_rad: tuple[float, float, float] = (1.2, 0.4, -0.7)
    lever_mm: tuple[float, float, float] = (19.0, -110.0, 8.0)

    @property
    def sensor_from_image(self) -> Rotation:
        """How the image is turned on the sensor."""
        return Rotation.from_euler("ZYX", self.mounting_rad)


def simulate_tracker(
    trajectory: Trajectory,
    span_s: tuple[float, float],
    model: TrackerModel,
    rng: np.random.Generator,
    noise: float = 1.0,
) -> Tracker:
    """Track the probe over `span_s` of image time; `noise` multiplies all errors but the clock's.

    The reading stamped t on the sensor's clock shows the probe at ``t - latency``.
    """
    clock = _clock(span_s, model.rate_hz, model.clock_jitter_s, rng)
    clock = clock[rng.random(clock.size) >= model.dropouts]
    true = trajectory.world_from_image(clock) * model.sensor_from_image.inv()
    translation, rotation = true.as_components()
    jitter = Rotation.from_rotvec(noise * model.orientation_rad * rng.standard_normal((clock.size, 3)))
    moved = translation + noise * model.position_mm * rng.standard_normal((clock.size, 3))
    readings = TimedPoses(clock + model.latency_s, RigidTransform.from_components(moved, rotation * jitter))
    return Tracker(readings, model.sensor_from_image, -model.latency_s)


def simulate_orientation(
    trajectory: Trajectory,
    span_s: tuple[float, float],
    model: OrientationModel,
    rng: np.random.Generator,
    noise: float = 1.0,
) -> OrientationSensor:
    """Orientation and raw inertial readings over `span_s` of image time; `noise` as of the tracker."""
    clock = _clock(span_s, model.rate_hz, model.clock_jitter_s, rng)
    poses = [trajectory.world_from_image(clock + shift) for shift in (-_DERIVATIVE_S, 0.0, _DERIVATIVE_S)]
    before, now, after = (pose.rotation * model.sensor_from_image.inv() for pose in poses)
    path = [pose.apply(np.asarray(model.lever_mm)) for pose in poses]
    slow_rad = np.array([model.inclination_rad, model.inclination_rad, model.heading_rad])
    wander = _wander(clock, model.wander_s, rng) * (noise * slow_rad)
    white = Rotation.from_rotvec(noise * model.white_rad * rng.standard_normal((clock.size, 3)))
    reported = Rotation.from_rotvec(wander) * now * white
    # At rest the specific force, acceleration minus gravity, points up.
    acceleration = 1e-3 * (path[0] - 2.0 * path[1] + path[2]) / _DERIVATIVE_S**2
    force = now.inv().apply(acceleration + np.array([0.0, 0.0, GRAVITY_M_S2]))
    rate = (before.inv() * after).as_rotvec() / (2.0 * _DERIVATIVE_S)
    field = now.inv().apply([np.cos(model.dip_rad), 0.0, -np.sin(model.dip_rad)])

    def noisy(true: FloatArray, bias: float, white: float) -> FloatArray:
        drawn = noise * bias * rng.standard_normal(3), noise * white * rng.standard_normal(true.shape)
        return np.asarray(true + drawn[0] + drawn[1])

    return OrientationSensor(
        TimedRotations(clock - model.time_offset_s, reported),
        model.sensor_from_image,
        model.time_offset_s,
        noisy(force, model.accelerometer_bias_m_s2, model.accelerometer_m_s2),
        noisy(rate, model.gyroscope_bias_rad_s, model.gyroscope_rad_s),
        noisy(field, 0.0, model.magnetometer_au),
    )


def _clock(
    span_s: tuple[float, float], rate_hz: float, jitter_s: float, rng: np.random.Generator
) -> FloatArray:
    first = span_s[0] + rng.uniform(0.0, 1.0 / rate_hz)
    n = int((span_s[1] - first) * rate_hz)
    return first + np.arange(n) / rate_hz + rng.uniform(-jitter_s, jitter_s, n)


def _wander(time_s: FloatArray, correlation_s: float, rng: np.random.Generator) -> FloatArray:
    """First-order random wander of unit standard deviation in three axes, shape (m, 3)."""
    keep = np.exp(-np.diff(time_s) / correlation_s)
    out = rng.standard_normal((time_s.size, 3))
    for i, k in enumerate(keep, start=1):
        out[i] = k * out[i - 1] + np.sqrt(1.0 - k * k) * out[i]
    return out
