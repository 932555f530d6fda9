"""Angle errors of an orientation sensor against a mechanism or an optical tracker."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import Json, emit, emit_rows, note
from speckle3d.cli.sensors.imu import (
    DEFAULT_SOURCE,
    Magnetometer,
    MethodOption,
    imu,
    orientation_of,
    require_finite_offset,
)
from speckle3d.cli.sensors.imu_logs import Log, RateHz, WorldOption, read, tell
from speckle3d.core.errors import InvalidInputError, naming

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

    from speckle3d.core.streams import TimedRotations


@imu.command("accuracy")
def imu_accuracy(
    log_file: Log,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Settings of a mechanism: CSV with tilt, yaw, roll in degrees, perhaps time_s and until_s."
        ),
    ] = None,
    optical: Annotated[
        Path | None,
        typer.Option(help="Orientation by a tracker: TUM text, or a log that carries its own orientation."),
    ] = None,
    calibrations: Annotated[
        list[Path] | None, typer.Option("--calibration", help="Calibration files; may be repeated.")
    ] = None,
    turns: Annotated[
        str, typer.Option(help="The mechanism's axes from its base to the probe.")
    ] = "roll, yaw, tilt",
    fit_mounting: Annotated[
        bool,
        typer.Option(
            "--fit-mounting/--aligned",
            help="The target's axes on the probe: found from the motion, or those of the image.",
        ),
    ] = True,
    time_offset_s: Annotated[
        float, typer.Option(help="A reading of the sensor at t belongs to the tracker's time t + this.")
    ] = 0.0,
    method: MethodOption = DEFAULT_SOURCE,
    magnetometer: Magnetometer = True,
    figure: Annotated[
        Path | None, typer.Option(help="PNG of single turns, as Figure 5 of the paper.")
    ] = None,
    rate_hz: RateHz = None,
    world: WorldOption = None,
    as_json: Json = False,
) -> None:
    """Compare the angles between all pairs of orientations with a reference's (Housden 2008, Table 2)."""
    from scipy.spatial.transform import Rotation

    from speckle3d.io.calibrations import read_calibration
    from xsens.accuracy.angles import AccuracyTable, pair_errors
    from xsens.accuracy.mechanism import read_mechanism_csv, readings_at

    if (reference is None) == (optical is None):
        raise InvalidInputError("expected --reference CSV of a mechanism or --optical FILE, one of them")
    require_finite_offset(time_offset_s)
    log = read(log_file, rate_hz, world)
    tell(log)
    mountings = Rotation.identity(1)
    if calibrations:
        mountings = Rotation.concatenate([read_calibration(path).rotation for path in calibrations])
    else:
        note("no --calibration: the sensor's axes are taken for the image's")
    with naming(str(log_file)):
        rotations, _ = orientation_of(log, method, magnetometer)
        if reference is not None:
            settings = read_mechanism_csv(reference, turns)
            measured, right = readings_at(rotations, settings), settings.base_from_image
        elif optical is not None:
            measured, right = _beside_tracker(rotations, optical, time_offset_s, fit_mounting, mountings)
        errors = pair_errors(measured, right, mountings)
    table = AccuracyTable.of({log_file.stem: errors})
    if figure is not None:
        from speckle3d.study.figures import save_figure
        from xsens.accuracy.figures import figure_turns

        save_figure(figure_turns({log_file.stem: errors}, log_file.name), figure)
    if as_json:
        emit_rows(table.values(), as_json)
        return
    emit(table.text())
    emit(f"{len(errors)} errors: pairs of {errors.frames} orientations, {len(mountings)} calibrations")


def _beside_tracker(
    rotations: TimedRotations, optical: Path, time_offset_s: float, fit_mounting: bool, mountings: Rotation
) -> tuple[Rotation, Rotation]:
    """Readings of the sensor, and the image's orientation by the tracker at the same moments."""
    from xsens.accuracy.angles import common_readings, mounting_from_motion

    measured, target = common_readings(rotations, _tracked(optical), time_offset_s)
    if not fit_mounting:
        return measured, target
    mounting = mounting_from_motion(measured * mountings.mean(), target)
    note("the target's mounting is found from the motion: constant errors of calibration do not show")
    return measured, target * mounting


def _tracked(path: Path) -> TimedRotations:
    """Read the orientation in a TUM file, or the one that a log carries."""
    from speckle3d.core.streams import TimedRotations
    from speckle3d.io.tum import is_tum, read_tum

    if is_tum(path):
        poses = read_tum(path)
        return TimedRotations(poses.time_s, poses.world_from_sensor.rotation)
    log = read(path)
    tell(log)
    return log.rotations()
