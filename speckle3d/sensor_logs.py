"""Logs of the orientation sensor from log files, sweeps and handheld packages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedRotations
from speckle3d.core.sweep import INERTIAL, OrientationSensor
from speckle3d.io.clarius.imu import MEANING
from speckle3d.io.clarius.reader import READER, sensor_of
from speckle3d.io.family.sweep_writer import attach_orientation
from speckle3d.io.load import load_sweep
from speckle3d.io.readers import find_reader
from xsens.logs.clocks import Stamps, timeline
from xsens.logs.faults import without_faults
from xsens.logs.samples import ImuLog


def held_log(path: Path) -> ImuLog | None:
    """Log of the sensor in a recording; None if the file is itself a log."""
    if find_reader(path) is not READER:
        sensor = ridden_along(path)
        return None if sensor is None else log_of(sensor, path.name)
    # The sensor inside a handheld scanner, whatever its images are.
    samples = sensor_of(path)
    rotations = samples.world_from_sensor
    meaning = () if rotations is None else (f"the sensor's quaternion is {MEANING}",)
    return _log(samples.vectors, samples.time_s, rotations, path.name, (*meaning, *samples.remarks))


def ridden_along(path: Path) -> OrientationSensor | None:
    """The orientation sensor of a sweep; None of what is a log or a handheld scanner's recording."""
    if find_reader(path) in (None, READER):
        return None
    sensor = load_sweep(path).orientation
    if sensor is None:
        raise InsufficientDataError(f"{path}: expected an orientation sensor's stream in the sweep, got none")
    return sensor


def log_of(sensor: OrientationSensor, source: str) -> ImuLog:
    """Log of a sweep's orientation sensor, on its own clock."""
    readings = sensor.readings
    return _log(vars(sensor), readings.time_s, readings.world_from_sensor, source)


def _log(
    vectors: Mapping[str, Any],
    time_s: FloatArray,
    rotations: Rotation | None,
    source: str,
    notes: Sequence[str] = (),
) -> ImuLog:
    clock = timeline(Stamps(time_s=time_s))
    log = ImuLog(
        clock.time_s,
        **{name: vectors[name] for name in INERTIAL},
        world_from_sensor=rotations,
        # A sensor without a counter may send in bursts: how many samples a pause lost is not known.
        gaps=tuple(replace(gap, lost=0) for gap in clock.gaps),
        notes=(*clock.notes, *notes),
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
    covered = None
    with suppress(InvalidInputError) if replaces else nullcontext():
        times_s = load_sweep(sweep_file).frame_time_s
        covered = int(sensor.covers(times_s).sum())
    if covered == 0:
        first, last = rotations.time_s[[0, -1]] + time_offset_s
        raise InvalidInputError(
            f"{sweep_file}: expected a stream that covers frames of the sweep, {times_s[0]:.3f} to "
            f"{times_s[-1]:.3f} s, got one from {first:.3f} to {last:.3f} s: covers 0 of {times_s.size} "
            "frames"
        )
    attach_orientation(sweep_file, sensor)
    return "" if covered is None else f": covers {covered} of {times_s.size} frames"
