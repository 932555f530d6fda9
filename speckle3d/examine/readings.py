"""A sensor's readings against themselves: spikes, standstills, and its own gyroscope and gravity."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.doubts import runs_of
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import OrientationSensor, Tracker

Sensor = TypeVar("Sensor", OrientationSensor, Tracker)

_WINDOW = 9
"""Readings of which the median is taken: up to four spikes in a row do not move it."""
_SPIKE_SIGMA = 10.0
_SPIKE_MM, _SPIKE_RAD = 3.0, float(np.deg2rad(5.0))
"""No hand goes so far and back between readings: at 50 Hz it would take 7 m/s^2 and 220 rad/s^2."""
_SLIP_MM_S, _SLIP_RAD_S = 250.0, float(np.deg2rad(300.0))
"""No scan is so fast, from one reading to the next."""
_STILL = 1e-9
"""Readings closer than this are the same: noise moves the last digits of any sensor that is read."""


def spikes(sensor: OrientationSensor | Tracker) -> BoolArray:
    """Which readings lie far off the median of those around them, shape (m,)."""
    samples = sensor.readings.world_from_sensor
    if len(samples) < _WINDOW:
        return np.zeros(len(samples), dtype=bool)
    rotation = samples.rotation if isinstance(samples, RigidTransform) else samples
    around = Rotation.from_matrix(nearest_rotation(_medians(rotation.as_matrix())))
    turned = np.atleast_1d((around.inv() * rotation).magnitude())
    found = turned > max(_SPIKE_RAD, _SPIKE_SIGMA * robust_sigma(turned))
    if isinstance(samples, RigidTransform):
        moved = np.linalg.norm(samples.translation - _medians(samples.translation), axis=1)
        found |= moved > max(_SPIKE_MM, _SPIKE_SIGMA * robust_sigma(moved))
    return np.asarray(found)


def _medians(values: FloatArray) -> FloatArray:
    """Running medians along the first axis."""
    return np.asarray(median_filter(values, (_WINDOW, *[1] * (values.ndim - 1)), mode="mirror"))


def slips(sensor: OrientationSensor | Tracker) -> IntArray:
    """Readings that go on elsewhere than those before them were, faster than any hand, shape (places,)."""
    samples, pause = sensor.readings.world_from_sensor, np.diff(sensor.readings.time_s)
    if len(samples) < _WINDOW:
        return np.zeros(0, dtype=np.int64)
    rotation = samples.rotation if isinstance(samples, RigidTransform) else samples
    rate = (rotation[:-1].inv() * rotation[1:]).magnitude() / pause
    found = rate > max(_SLIP_RAD_S, _SPIKE_SIGMA * float(np.median(rate)))
    if isinstance(samples, RigidTransform):
        speed = np.linalg.norm(np.diff(samples.translation, axis=0), axis=1) / pause
        found |= speed > max(_SLIP_MM_S, _SPIKE_SIGMA * float(np.median(speed)))
    return np.flatnonzero(found) + 1


def frames_at(
    sensor: OrientationSensor | Tracker, readings: IntArray, frame_time_s: FloatArray
) -> tuple[tuple[int, int], ...]:
    """Frames nearest to some readings; none for those before the first frame or after the last."""
    time_s = sensor.readings.time_s[readings] + sensor.time_offset_s
    time_s = time_s[(time_s >= frame_time_s[0]) & (time_s <= frame_time_s[-1])]
    middle = (frame_time_s[:-1] + frame_time_s[1:]) / 2
    return runs_of(np.searchsorted(middle, time_s))


def without(sensor: Sensor, left_out: BoolArray) -> Sensor:
    """The sensor less some of its readings, and what was measured with them."""
    keep = ~left_out
    readings = sensor.readings
    less = replace(readings, time_s=readings.time_s[keep], world_from_sensor=readings.world_from_sensor[keep])
    if isinstance(sensor, Tracker):
        return replace(sensor, readings=less)
    names = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")
    vectors = {name: getattr(sensor, name) for name in names}
    kept = {name: value[keep] for name, value in vectors.items() if value is not None}
    return replace(sensor, readings=less, **kept)


def jitter(sensor: OrientationSensor | Tracker) -> tuple[float, float]:
    """Standard deviation of a step between readings but for the motion itself, mm and degrees."""
    samples = sensor.readings.world_from_sensor
    rotation = samples.rotation if isinstance(samples, RigidTransform) else samples
    turns = (rotation.mean().inv() * rotation).as_rotvec(degrees=True)
    places = samples.translation if isinstance(samples, RigidTransform) else np.zeros((len(turns), 3))
    if len(turns) < 3:
        return 0.0, 0.0
    # A second difference of white noise varies six times as much, a step twice.
    second = (np.sqrt(1.0 / 3.0) * (each[2:] - 2.0 * each[1:-1] + each[:-2]) for each in (places, turns))
    size = [max(robust_sigma(column) for column in each.T) for each in second]
    return size[0], size[1]


def standstill(sensor: OrientationSensor | Tracker) -> tuple[float, float]:
    """Begin and end of the longest time over which the readings are all the same, s; empty without one."""
    samples, time_s = sensor.readings.world_from_sensor, sensor.readings.time_s
    if len(samples) < 2:
        return float(time_s[0]), float(time_s[0])
    still = _unchanged(samples)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    begin, end = edges[::2], edges[1::2]
    if not begin.size:
        return float(time_s[0]), float(time_s[0])
    longest = int(np.argmax(time_s[end] - time_s[begin]))
    return float(time_s[begin[longest]]), float(time_s[end[longest]])


def _unchanged(samples: RigidTransform | Rotation) -> BoolArray:
    if isinstance(samples, RigidTransform):
        step = samples[:-1].inv() * samples[1:]
        moved = np.linalg.norm(step.translation, axis=1)
        return np.asarray((step.rotation.magnitude() < _STILL) & (moved < _STILL))
    return np.asarray((samples[:-1].inv() * samples[1:]).magnitude() < _STILL)
