"""Sensors that ride on the simulated probe, each on its own clock, with its own errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

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


_ERRORS = (
    "position_mm",
    "orientation_rad",
    "inclination_rad",
    "heading_rad",
    "white_rad",
    "gyroscope_rad_s",
    "gyroscope_bias_rad_s",
    "accelerometer_m_s2",
    "accelerometer_bias_m_s2",
    "magnetometer_au",
)

Model = TypeVar("Model", TrackerModel, OrientationModel)


def with_noise(model: Model, factor: float) -> Model:
    """Return the same sensor with all of its errors multiplied, those of its clock excepted."""
    errors = {name: value for name, value in vars(model).items() if name in _ERRORS}
    return replace(model, **{name: factor * value for name, value in errors.items()})


def simulate_tracker(
    trajectory: Trajectory, span_s: tuple[float, float], model: TrackerModel, rng: np.random.Generator
) -> Tracker:
    """Track the probe over `span_s` of image time.

    The reading stamped t on the sensor's clock shows the probe at ``t - latency``.
    """
    clock = _clock(span_s, model.rate_hz, model.clock_jitter_s, rng)
    clock = clock[rng.random(clock.size) >= model.dropouts]
    true = trajectory.world_from_image(clock) * model.sensor_from_image.inv()
    translation, rotation = true.as_components()
    jitter = Rotation.from_rotvec(model.orientation_rad * rng.standard_normal((clock.size, 3)))
    moved = translation + model.position_mm * rng.standard_normal((clock.size, 3))
    readings = TimedPoses(clock + model.latency_s, RigidTransform.from_components(moved, rotation * jitter))
    return Tracker(readings, model.sensor_from_image, -model.latency_s)


def simulate_orientation(
    trajectory: Trajectory, span_s: tuple[float, float], model: OrientationModel, rng: np.random.Generator
) -> OrientationSensor:
    """Orientation and raw inertial readings over `span_s` of image time."""
    clock = _clock(span_s, model.rate_hz, model.clock_jitter_s, rng)
    world_from_sensor = _sensor_rotation(trajectory, model, clock)
    slow_rad = [model.inclination_rad, model.inclination_rad, model.heading_rad]
    wander = _wander(clock, model.wander_s, rng) * slow_rad
    white = Rotation.from_rotvec(model.white_rad * rng.standard_normal((clock.size, 3)))
    reported = Rotation.from_rotvec(wander) * world_from_sensor * white
    force, rate = _specific_force(trajectory, model, clock), _angular_rate(trajectory, model, clock)
    field = world_from_sensor.inv().apply([np.cos(model.dip_rad), 0.0, -np.sin(model.dip_rad)])
    return OrientationSensor(
        TimedRotations(clock - model.time_offset_s, reported),
        model.sensor_from_image,
        model.time_offset_s,
        _noisy(force, model.accelerometer_bias_m_s2, model.accelerometer_m_s2, rng),
        _noisy(rate, model.gyroscope_bias_rad_s, model.gyroscope_rad_s, rng),
        _noisy(field, 0.0, model.magnetometer_au, rng),
    )


def _clock(
    span_s: tuple[float, float], rate_hz: float, jitter_s: float, rng: np.random.Generator
) -> FloatArray:
    first = span_s[0] + rng.uniform(0.0, 1.0 / rate_hz)
    n = int((span_s[1] - first) * rate_hz)
    return first + np.arange(n) / rate_hz + rng.uniform(-jitter_s, jitter_s, n)


def _sensor_rotation(trajectory: Trajectory, model: OrientationModel, time_s: FloatArray) -> Rotation:
    return trajectory.world_from_image(time_s).rotation * model.sensor_from_image.inv()


def _angular_rate(trajectory: Trajectory, model: OrientationModel, time_s: FloatArray) -> FloatArray:
    """Angular rate in the sensor frame, rad/s."""
    before = _sensor_rotation(trajectory, model, time_s - _DERIVATIVE_S)
    after = _sensor_rotation(trajectory, model, time_s + _DERIVATIVE_S)
    return np.asarray((before.inv() * after).as_rotvec() / (2.0 * _DERIVATIVE_S))


def _specific_force(trajectory: Trajectory, model: OrientationModel, time_s: FloatArray) -> FloatArray:
    """Acceleration minus gravity at the sensor, in its frame, m/s^2: at rest it points up."""
    lever = np.asarray(model.lever_mm)
    before, now, after = (
        trajectory.world_from_image(time_s + shift).apply(lever)
        for shift in (-_DERIVATIVE_S, 0.0, _DERIVATIVE_S)
    )
    acceleration = 1e-3 * (before - 2.0 * now + after) / _DERIVATIVE_S**2
    world = acceleration + np.array([0.0, 0.0, GRAVITY_M_S2])
    return np.asarray(_sensor_rotation(trajectory, model, time_s).inv().apply(world))


def _noisy(true: FloatArray, bias: float, white: float, rng: np.random.Generator) -> FloatArray:
    return np.asarray(true + bias * rng.standard_normal(3) + white * rng.standard_normal(true.shape))


def _wander(time_s: FloatArray, correlation_s: float, rng: np.random.Generator) -> FloatArray:
    """First-order random wander of unit standard deviation in three axes, shape (m, 3)."""
    keep = np.exp(-np.diff(time_s) / correlation_s)
    out = rng.standard_normal((time_s.size, 3))
    for i, k in enumerate(keep, start=1):
        out[i] = k * out[i - 1] + np.sqrt(1.0 - k * k) * out[i]
    return out
