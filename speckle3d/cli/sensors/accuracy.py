"""Accuracy of the orientation sensor against a mechanism or a tracker."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import (
    MaybeNumber,
    MaybePath,
    Paths,
    Result,
    WritablePath,
    note,
    rows_of,
)
from speckle3d.cli.sensors.imu import Method, World, note_gaps, orientation_of, read
from speckle3d.core.errors import naming

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

    from speckle3d.core.streams import TimedRotations


def accuracy(
    log_file: Path,
    reference: MaybePath = None,
    optical: MaybePath = None,
    calibration: Paths = None,
    turns: str = "roll, yaw, tilt",
    fit_mounting: Annotated[bool, typer.Option("--fit-mounting/--aligned")] = True,
    time_offset_s: float = 0.0,
    method: Method = "smoother",
    magnetometer: bool = True,
    figure: Annotated[WritablePath, "picture"] = None,
    rate_hz: MaybeNumber = None,
    world: World = None,
) -> Result:
    """Compare the angles between all pairs of orientations with a reference's (Housden 2008, Table 2).

    One of --reference or --optical.

    Parameters
    ----------
    log_file
    reference
        Settings of a mechanism: CSV with tilt, yaw, roll in degrees, perhaps time_s and until_s.
    optical
        Orientation by a tracker: TUM text, or a log that carries its own orientation.
    calibration
        Calibration files; may be repeated.
    method
    figure
        PNG of single turns, as Figure 5 of the paper.
    as_json

    Other Parameters
    ----------------
    turns
        With --reference: the mechanism's axes from its base to the probe.
    fit_mounting
        With --optical: the target's axes on the probe: found from the motion, or those of the image.
    time_offset_s
        With --optical: a reading of the sensor at t belongs to the tracker's time t + this.
    magnetometer, rate_hz, world

    Examples
    --------
    $ speckle3d imu accuracy log.mtb --optical tracker.tum --calibration imu.h5
    """
    from scipy.spatial.transform import Rotation

    from speckle3d.io.calibrations import read_calibration
    from speckle3d.study.figures import save_figure
    from xsens.accuracy.angles import AccuracyTable, pair_errors
    from xsens.accuracy.figures import figure_turns
    from xsens.accuracy.mechanism import read_mechanism_csv, readings_at

    log = read(log_file, rate_hz, world)
    note_gaps(log)
    mountings = Rotation.identity(1)
    if calibration:
        mountings = Rotation.concatenate([read_calibration(path).rotation for path in calibration])
    else:
        note("no --calibration: the sensor's axes are taken for the image's")
    mechanism = None if reference is None else read_mechanism_csv(reference, turns)
    with naming(str(log_file)):
        rotations, _ = orientation_of(log, method, magnetometer)
        if mechanism is not None:
            readings, truth = readings_at(rotations, mechanism), mechanism.base_from_image
        elif optical is not None:
            readings, truth = _beside_tracker(rotations, optical, time_offset_s, fit_mounting, mountings)
        errors = pair_errors(readings, truth, mountings)
    table = AccuracyTable.of({log_file.stem: errors})
    if figure is not None:
        save_figure(figure_turns({log_file.stem: errors}, log_file.name), figure)
    how = f"{len(errors)} errors: pairs of {errors.frames} orientations, {len(mountings)} calibrations"
    return rows_of(table.values())[0], f"{table.text()}\n{how}"


def _beside_tracker(
    rotations: TimedRotations, optical: Path, time_offset_s: float, fit_mounting: bool, mountings: Rotation
) -> tuple[Rotation, Rotation]:
    """Readings of the sensor, and the image's orientation by the tracker at the same moments."""
    from speckle3d.core.streams import TimedRotations
    from speckle3d.io.tum import is_tum, read_tum
    from xsens.accuracy.angles import common_readings, mounting_from_motion

    if is_tum(optical):
        poses = read_tum(optical)
        target_stream = TimedRotations(poses.time_s, poses.world_from_sensor.rotation)
    else:
        log = read(optical)
        note_gaps(log)
        target_stream = log.rotations()
    readings, target = common_readings(rotations, target_stream, time_offset_s)
    if not fit_mounting:
        return readings, target
    note("the target's mounting is found from the motion: constant errors of calibration do not show")
    return readings, target * mounting_from_motion(readings * mountings.mean(), target)
