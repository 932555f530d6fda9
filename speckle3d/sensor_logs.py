"""Logs of the orientation sensor, whatever holds them: a file of its own, a sweep, the sensor in a probe."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedRotations
from speckle3d.core.sweep import INERTIAL, OrientationSensor
from speckle3d.io.clarius.imu import MEANING
from speckle3d.io.clarius.reader import READER, sensor_of
from speckle3d.io.load import load_sweep
from speckle3d.io.readers import find_reader
from speckle3d.io.sweep_writer import attach_orientation
from xsens.logs.clocks import Stamps, timeline
from xsens.logs.faults import without_faults
from xsens.logs.samples import Gap, ImuLog


def held_log(path: Path) -> ImuLog | None:
    """Log of the sensor that a recording holds; None of what is a log itself."""
    inside = _inside_probe(path)
    if inside is None and (sensor := ridden_along(path)) is not None:
        return log_of(sensor, path.name)
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
    clock, rotations = timeline(Stamps(time_s=samples.time_s)), samples.world_from_sensor
    meaning = () if rotations is None else (f"the sensor's quaternion is {MEANING}",)
    log = ImuLog(
        clock.time_s,
        samples.accelerometer_m_s2,
        samples.gyroscope_rad_s,
        samples.magnetometer_au,
        world_from_sensor=rotations,
        gaps=_pauses(clock.gaps),
        notes=(*clock.notes, *meaning, *samples.remarks),
        source=path.name,
    )
    return without_faults(log)


def log_of(sensor: OrientationSensor, source: str) -> ImuLog:
    """Log of a sweep's orientation sensor, on its own clock."""
    clock = timeline(Stamps(time_s=sensor.readings.time_s))
    log = ImuLog(
        clock.time_s,
        **{name: getattr(sensor, name) for name in INERTIAL},
        world_from_sensor=sensor.readings.world_from_sensor,
        gaps=_pauses(clock.gaps),
        notes=clock.notes,
        source=source,
    )
    return without_faults(log)


def with_orientation(log: ImuLog, rotations: TimedRotations) -> ImuLog:
    """Replace the sensor's own orientation in a log."""
    rows = np.isin(log.time_s, rotations.time_s)
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(log), 1))
    quaternions[rows] = rotations.world_from_sensor.as_quat()
    return replace(log, world_from_sensor=Rotation.from_quat(quaternions), oriented=rows)


def attach_log(
    sweep_file: Path,
    log: ImuLog,
    rotations: TimedRotations,
    mounting: Rotation | None,
    time_offset_s: float,
    replaces: bool,
) -> str:
    """Put a log with its orientation into a sweep file; returns how many frames it covers, in words.

    Parameters
    ----------
    replaces : bool
        Whether it may take the place of a stream, which may be why the sweep cannot be read.

    Raises
    ------
    InvalidInputError
        If the stream covers no frame.
    """
    rows = np.isin(log.time_s, rotations.time_s)
    vectors = {}
    for name in INERTIAL:
        values = getattr(log, name)
        whole = values is not None and bool(np.isfinite(values[rows]).all())
        vectors[name] = values[rows] if whole and rows.sum() == len(rotations) else None
    sensor = OrientationSensor(rotations, mounting, time_offset_s, **vectors)
    words = ""
    with suppress(InvalidInputError) if replaces else nullcontext():
        times_s = load_sweep(sweep_file).frame_time_s
        words = f": covers {int(sensor.covers(times_s).sum())} of {times_s.size} frames"
    if words.startswith(": covers 0 "):
        first, last = sensor.readings.time_s[[0, -1]] + sensor.time_offset_s
        raise InvalidInputError(
            f"{sweep_file}: expected a stream that covers frames of the sweep, {times_s[0]:.3f} to "
            f"{times_s[-1]:.3f} s, got one from {first:.3f} to {last:.3f} s{words}"
        )
    attach_orientation(sweep_file, sensor)
    return words


def _pauses(gaps: Sequence[Gap]) -> tuple[Gap, ...]:
    """Gaps of a sensor without a counter that may send in bursts: how many were lost is not known."""
    return tuple(replace(gap, lost=0) for gap in gaps)
