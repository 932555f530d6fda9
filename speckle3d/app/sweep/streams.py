"""Readings of a sweep's sensors over the images' clock, as curves to look at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker


@dataclass(frozen=True)
class Stream:
    """Three quantities of one sensor.

    Attributes
    ----------
    name : str
        What they are.
    unit : str
    parts : tuple of str
    time_s : ndarray, shape (m,)
        On the images' clock.
    values : ndarray, shape (m, 3)
        NaN between readings that are too far apart to be joined.
    """

    name: str
    unit: str
    parts: tuple[str, str, str]
    time_s: FloatArray
    values: FloatArray


_ABOUT = ("tilt", "yaw", "roll")
_AXES = ("x", "y", "z")
_PLACES = ("lateral", "axial", "elevational")


def streams_of(sweep: Sweep) -> dict[str, list[Stream]]:
    """What each sensor of a sweep measured, by the sensor's name; none for a sweep without sensors."""
    found = {}
    if sweep.orientation is not None:
        found["orientation sensor"] = list(_of_orientation(sweep.orientation))
    if sweep.tracker is not None:
        found["tracker"] = list(_of_tracker(sweep.tracker, sweep.grid.centre_mm))
    return found


def _of_orientation(sensor: OrientationSensor) -> Iterator[Stream]:
    rotation = sensor.readings.world_from_sensor
    calibrated = sensor.sensor_from_image is not None
    if sensor.sensor_from_image is not None:
        rotation = rotation * sensor.sensor_from_image
    yield _turn(sensor, rotation, calibrated)
    if sensor.gyroscope_rad_s is not None:
        yield _stream(sensor, "rate of turn", "degrees/s", _AXES, np.degrees(sensor.gyroscope_rad_s))
    if sensor.accelerometer_m_s2 is not None:
        yield _stream(sensor, "acceleration", "m/s²", _AXES, sensor.accelerometer_m_s2)
    if sensor.magnetometer_au is not None:
        yield _stream(sensor, "magnetic field", "a.u.", _AXES, sensor.magnetometer_au)


def _of_tracker(tracker: Tracker, centre_mm: FloatArray) -> Iterator[Stream]:
    poses = tracker.readings.world_from_sensor
    calibrated = tracker.sensor_from_image is not None
    at = np.zeros(3)
    if tracker.sensor_from_image is not None:
        poses, at = poses * tracker.sensor_from_image, centre_mm
    moved = (poses[0].inv() * poses).apply(at) - at
    name = "path of the image's centre" if calibrated else "path of the sensor"
    yield _stream(tracker, name, "mm", _PLACES if calibrated else _AXES, moved)
    yield _turn(tracker, poses.rotation, calibrated)


def _turn(sensor: OrientationSensor | Tracker, rotation: Rotation, calibrated: bool) -> Stream:
    turned = np.degrees((rotation[0].inv() * rotation).as_rotvec())
    name = "turn of the image" if calibrated else "turn of the sensor (not calibrated)"
    return _stream(sensor, name, "degrees", _ABOUT if calibrated else _AXES, turned)


def _stream(
    sensor: OrientationSensor | Tracker,
    name: str,
    unit: str,
    parts: tuple[str, str, str],
    values: FloatArray,
) -> Stream:
    """Values with a break in each gap of the readings."""
    time_s = sensor.readings.time_s + sensor.time_offset_s
    gaps = np.flatnonzero(np.diff(time_s) > sensor.readings.max_gap_s) + 1
    return Stream(
        name, unit, parts, np.insert(time_s, gaps, time_s[gaps]), np.insert(values, gaps, np.nan, axis=0)
    )
