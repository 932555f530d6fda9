"""Logs of the orientation sensor, whatever holds them: a file of its own, a sweep, the sensor in a probe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.sweep import INERTIAL, OrientationSensor
from speckle3d.io.clarius import READER
from speckle3d.io.clarius.imu import MEANING
from speckle3d.io.clarius.reader import sensor_of
from speckle3d.io.load import load_sweep
from speckle3d.io.readers import find_reader
from xsens.logs.clocks import timeline_of_times
from xsens.logs.faults import measured
from xsens.logs.samples import Gap, ImuLog


def held_log(path: Path) -> ImuLog | None:
    """Log of the sensor that a recording holds; None of what is a log itself."""
    inside = _inside_probe(path)
    if inside is None and (held := ridden_along(path)) is not None:
        return log_of(held, path.name)
    return inside


def ridden_along(path: Path) -> OrientationSensor | None:
    """The orientation sensor that a sweep was recorded with, as one inside a probe; None of what is a log."""
    if find_reader(path) is None or _inside_probe(path) is not None:
        return None
    sensor = load_sweep(path).orientation
    if sensor is None:
        raise InsufficientDataError(f"{path}: expected an orientation sensor's stream in the sweep, got none")
    return sensor


def _inside_probe(path: Path) -> ImuLog | None:
    """Log of the sensor inside a handheld scanner, whatever its images are; None of other recordings."""
    if find_reader(path) is not READER:
        return None
    samples = sensor_of(path)
    clock, fit = timeline_of_times(samples.time_s), samples.fit
    found = "is not used: it does not agree with gravity" if fit is None else f"is {MEANING}"
    log = ImuLog(
        clock.time_s,
        samples.accelerometer_m_s2,
        samples.gyroscope_rad_s,
        samples.magnetometer_gauss,
        world_from_sensor=None if fit is None else fit.world_from_sensor,
        gaps=_pauses(clock.gaps),
        notes=(*clock.notes, f"the sensor's quaternion {found}", *samples.remarks),
        source=path.name,
    )
    return measured(log)


def log_of(sensor: OrientationSensor, source: str) -> ImuLog:
    """Log of a sweep's orientation sensor, on its own clock."""
    clock = timeline_of_times(sensor.readings.time_s)
    log = ImuLog(
        clock.time_s,
        **{name: getattr(sensor, name) for name in INERTIAL},
        world_from_sensor=sensor.readings.world_from_sensor,
        gaps=_pauses(clock.gaps),
        notes=clock.notes,
        source=source,
    )
    return measured(log)


def _pauses(gaps: Sequence[Gap]) -> tuple[Gap, ...]:
    """Gaps of a sensor without a counter that may send in bursts: how many were lost is not known."""
    return tuple(replace(gap, lost=0) for gap in gaps)
