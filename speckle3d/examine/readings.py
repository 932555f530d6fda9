"""A sensor's readings against themselves: spikes, slips, jitter and standstills."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import OrientationSensor, Tracker

Sensor = TypeVar("Sensor", OrientationSensor, Tracker)

_WINDOW = 9
"""Readings of which the median is taken: up to four spikes in a row do not move it."""
_SPIKE_SIGMA = 10.0
_SPIKE = float(np.deg2rad(5.0)), 3.0
"""Turn, rad, and distance, mm, that no hand goes and comes back between readings: at 50 Hz it would take 220
rad/s^2 and 7 m/s^2."""
_SLIP = float(np.deg2rad(300.0)), 250.0
"""Rates, rad/s and mm/s, of no scan, from one reading to the next."""
_STILL = 1e-9
"""Readings closer than this are the same: noise moves the last digits of any sensor that is read."""


def rigid(samples: RigidTransform | Rotation) -> RigidTransform:
    """Readings as rigid transforms; an orientation sensor's are all at the origin."""
    return samples if isinstance(samples, RigidTransform) else RigidTransform.from_rotation(samples)


def _steps(poses: RigidTransform, others: RigidTransform) -> FloatArray:
    """Turn, rad, and distance, mm, from poses to others, shape (2, n)."""
    moved = np.linalg.norm(others.translation - poses.translation, axis=1)
    return np.stack([(poses.rotation.inv() * others.rotation).magnitude(), moved])


def spikes(sensor: OrientationSensor | Tracker) -> BoolArray:
    """Which readings lie far off the median of those around them, shape (m,)."""
    poses = rigid(sensor.readings.world_from_sensor)
    if len(poses) < _WINDOW:
        return np.zeros(len(poses), dtype=bool)
    place = median_filter(poses.translation, (_WINDOW, 1), mode="mirror")
    matrix = median_filter(poses.rotation.as_matrix(), (_WINDOW, 1, 1), mode="mirror")
    turn = Rotation.from_matrix(nearest_rotation(matrix))
    off = _steps(RigidTransform.from_components(place, turn), poses)
    limits = [max(most, _SPIKE_SIGMA * robust_sigma(size)) for most, size in zip(_SPIKE, off, strict=True)]
    return np.asarray((off > np.array(limits)[:, None]).any(axis=0))


def slips(sensor: OrientationSensor | Tracker) -> IntArray:
    """Readings that go on elsewhere than those before them were, faster than any hand, shape (places,)."""
    poses = rigid(sensor.readings.world_from_sensor)
    if len(poses) < _WINDOW:
        return np.zeros(0, dtype=np.int64)
    rate = _steps(poses[:-1], poses[1:]) / np.diff(sensor.readings.time_s)
    limit = np.maximum(_SLIP, _SPIKE_SIGMA * np.median(rate, axis=1))
    return np.flatnonzero((rate > limit[:, None]).any(axis=0)) + 1


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
    kept: dict[str, Any] = {
        name: value[keep] for name, value in vars(sensor).items() if isinstance(value, np.ndarray)
    }
    return replace(sensor, readings=less, **kept)


def jitter(poses: RigidTransform, at_mm: FloatArray) -> tuple[float, float]:
    """Standard deviation of the place of a point, mm, and of the turn, rad, of poses but for slow motion."""
    if len(poses) < 3:
        return 0.0, 0.0
    turns = (poses.rotation.mean().inv() * poses.rotation).as_rotvec()
    # A second difference of white noise varies six times as much.
    second = (np.diff(values, 2, axis=0) / np.sqrt(6.0) for values in (poses.apply(at_mm), turns))
    place, turn = (max(robust_sigma(column) for column in each.T) for each in second)
    return place, turn


def standstill(sensor: OrientationSensor | Tracker) -> tuple[float, float]:
    """Begin and end of the longest time over which the readings are all the same, s; empty without one."""
    poses, time_s = rigid(sensor.readings.world_from_sensor), sensor.readings.time_s
    still = (_steps(poses[:-1], poses[1:]) < _STILL).all(axis=0) if len(poses) > 1 else np.zeros(0, bool)
    runs = runs_of(np.flatnonzero(still))
    spans = [(float(time_s[first]), float(time_s[last + 1])) for first, last in runs]
    return max(spans, key=lambda span: span[1] - span[0], default=(float(time_s[0]),) * 2)


def runs_of(frames: IntArray) -> tuple[tuple[int, int], ...]:
    """First and last of every run of consecutive frames.

    Parameters
    ----------
    frames : ndarray of int
        In any order; any number of times each.

    Examples
    --------
    >>> runs_of(np.array([7, 3, 4, 4]))
    ((3, 4), (7, 7))
    """
    ordered = np.unique(frames)
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
    return tuple((int(run[0]), int(run[-1])) for run in runs if run.size)
