"""Calibration of a sensor to the image with a phantom, a plane or wires, and how calibrations repeat."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from speckle3d.cli.calibrations import report_written, require_free
from speckle3d.cli.common import (
    CalibrationOut,
    Images,
    Json,
    PixelMm,
    Poses,
    Region,
    Transform,
    calibrate,
    emit,
    emit_json,
    from_options,
    note,
)
from speckle3d.core.errors import InvalidInputError, naming
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from speckle3d.calibrating.settings import ScanSettings

TimeOffset = Annotated[str | None, typer.Option(help="Seconds to add to the sensor's clock, or `estimate`.")]
FixedPixels = Annotated[
    bool, typer.Option("--fixed-pixels", help="Keep the pixel size instead of estimating it.")
]
PixelError = Annotated[
    float, typer.Option(min=0.0, help="Standard error of the pixel size, as a share of it; inf if a guess.")
]
OutlierSigma = Annotated[
    float, typer.Option(min=1.0, help="Drop frames whose residual exceeds so many standard deviations.")
]
Columns = Annotated[int | None, typer.Option(help="Lines: columns sampled (n).")]
SmoothingMm = Annotated[
    float | None, typer.Option(help="Lines: standard deviation of the smoothing (sigma).")
]
Threshold = Annotated[float | None, typer.Option(help="Lines: slope that makes an edge, levels/mm (T).")]
ToleranceMm = Annotated[float | None, typer.Option(help="Lines: how near an edge must be to agree (d).")]
Consensus = Annotated[float | None, typer.Option(help="Lines: part of the possible columns that agree (p).")]
Place = Annotated[str | None, typer.Option(help="Lines: where on an echo: front, slope or peak.")]
LeaveOut = Annotated[
    str | None, typer.Option(metavar="FRAMES", help="Frames to leave out, from 0, as 3,17-20.")
]
Validation = Annotated[
    Path | None, typer.Option(help="Another recording of the phantom, on which the calibration is checked.")
]


@calibrate.command("plane")
def calibrate_plane(
    images: Images,
    out: CalibrationOut,
    poses: Poses = None,
    transform: Transform = None,
    pixel_mm: PixelMm = None,
    fixed_pixels: FixedPixels = False,
    pixel_error: PixelError = 0.02,
    stages: Annotated[
        Literal["three", "one"], typer.Option(help="Angles, distances, all; or all at once.")
    ] = "three",
    reflector: Annotated[
        Literal["wall", "bar"],
        typer.Option(help="A bare wall, whose bias is predicted, or a thin bar (Cambridge)."),
    ] = "wall",
    beam_mm: Annotated[
        list[float] | None, typer.Option(help="Thickness of the beam for that prediction; may be repeated.")
    ] = None,
    region: Region = None,
    time_offset_s: TimeOffset = None,
    outlier_sigma: OutlierSigma = 4.0,
    validation: Validation = None,
    columns: Columns = None,
    smoothing_mm: SmoothingMm = None,
    threshold: Threshold = None,
    tolerance_mm: ToleranceMm = None,
    consensus: Consensus = None,
    place: Place = None,
    leave_out: LeaveOut = None,
    as_json: Json = False,
) -> None:
    """Calibrate a position sensor with the floor of a water bath, or the Cambridge phantom."""
    from speckle3d.calibrating.settings import PlaneSettings

    given = {**locals(), **_parsed(region, time_offset_s, leave_out)}
    _calibrate(images, from_options(PlaneSettings, given), out, validation, as_json=as_json)


@calibrate.command("orientation")
def calibrate_orientation(
    images: Images,
    out: CalibrationOut,
    poses: Poses = None,
    transform: Transform = None,
    pixel_mm: PixelMm = None,
    level: Annotated[
        bool, typer.Option("--level", help="The plane is level: three unknowns, not five.")
    ] = False,
    viewed_from: Annotated[
        Literal["above", "below"], typer.Option(help="Whether the beam points down on average, or up.")
    ] = "above",
    sensor: Annotated[
        Literal["orientation", "tracker"],
        typer.Option(help="orientation, or tracker: use only what a tracker says of orientation."),
    ] = "orientation",
    region: Region = None,
    time_offset_s: TimeOffset = None,
    outlier_sigma: OutlierSigma = 4.0,
    validation: Validation = None,
    columns: Columns = None,
    smoothing_mm: SmoothingMm = None,
    threshold: Threshold = None,
    tolerance_mm: ToleranceMm = None,
    consensus: Consensus = None,
    place: Place = None,
    leave_out: LeaveOut = None,
    as_json: Json = False,
) -> None:
    """Calibrate an orientation sensor with the floor of a water bath; gravity tells the mirror image."""
    from speckle3d.calibrating.settings import OrientationSettings

    given = {**locals(), **_parsed(region, time_offset_s, leave_out)}
    _calibrate(images, from_options(OrientationSettings, given), out, validation, as_json=as_json)


@calibrate.command("wires")
def calibrate_wires(
    images: Images,
    out: CalibrationOut,
    phantom: Annotated[str, typer.Option(help="cross, three, or a PLUS configuration of N-wires.")],
    points: Annotated[
        Path | None, typer.Option(help="CSV of points picked by hand: frame,column_px,row_px[,wire].")
    ] = None,
    poses: Poses = None,
    transform: Transform = None,
    pixel_mm: PixelMm = None,
    fixed_pixels: FixedPixels = False,
    registration: Annotated[
        Literal["auto", "held", "turned", "free"],
        typer.Option(
            help="The place a configuration says: hold it, its middle only, or estimate it; auto: whichever "
            "explains frames best that were left out."
        ),
    ] = "auto",
    beside_mm: Annotated[
        float,
        typer.Option(help="How far the hand misses a crossing, out of plane, RMS, mm: claims allow for it."),
    ] = 0.1,
    region: Region = None,
    time_offset_s: TimeOffset = None,
    outlier_sigma: OutlierSigma = 4.0,
    validation: Validation = None,
    validation_points: Annotated[
        Path | None, typer.Option(help="CSV of points picked by hand in that other recording.")
    ] = None,
    leave_out: LeaveOut = None,
    as_json: Json = False,
) -> None:
    """Calibrate a position sensor with crossing wires, three orthogonal wires or N-shapes."""
    from speckle3d.calibrating.settings import WireSettings

    if validation is None and validation_points is not None:
        raise InvalidInputError("--validation-points: expected the recording in --validation, got none")
    given = {**locals(), **_parsed(region, time_offset_s, leave_out)}
    others = (points, validation_points, Path(phantom))
    _calibrate(images, from_options(WireSettings, given), out, validation, validation_points, others, as_json)


def _parsed(region: str | None, time_offset_s: str | None, leave_out: str | None) -> dict[str, Any]:
    from speckle3d.calibrating.settings import frames_of, offset_of, region_of

    return {
        "region": region_of(region),
        "time_offset_s": offset_of(time_offset_s),
        "leave_out": frames_of(leave_out),
    }


def _calibrate(
    images: Path,
    settings: ScanSettings,
    out: Path,
    validation: Path | None,
    validation_points: Path | None = None,
    others: Sequence[Path | None] = (),
    as_json: bool = False,
) -> None:
    """Calibrate, check on the other recording, and write the calibration, its report and the dots."""
    from speckle3d.calibrating.phantoms import found, opened, remarks, solved, validated, write_outcome

    require_free(out, images, settings.poses, validation, *others)
    recording = opened(images, settings, settings.poses)
    with progress_bar(f"looking into {images.name}") as progress, naming(str(images)):
        seen = found(recording, settings, getattr(settings, "points", None), progress)
    with naming(str(images)):
        outcome = solved(recording, seen, settings)
    notes, more = remarks(outcome), []
    if validation is not None:
        with progress_bar(f"looking into {validation.name}") as progress:
            notes += validated(outcome, validation, settings, validation_points, progress)
        more += ["--validation", str(validation)]
    if validation_points is not None:
        more += ["--validation-points", str(validation_points)]
    written = write_outcome(outcome, settings, images, out, notes, more)
    report_written(written, notes, outcome.beam, as_json)


@calibrate.command("repeatability")
def calibrate_repeatability(
    calibrations: Annotated[list[Path], typer.Argument(help="Calibration files of one mounting.")],
    size_px: Annotated[
        tuple[int, int] | None, typer.Option(help="Columns and rows of the image, for centre and corners.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare repeated calibrations: scatter of roll, yaw and tilt, and of the image's centre and corners."""
    import numpy as np

    from calibration.repeatability import repeatability
    from speckle3d.io.calibrations import read_calibration

    found = repeatability([read_calibration(path) for path in calibrations], size_px)
    roll, yaw, tilt = (float(angle) for angle in np.rad2deg(found.roll_yaw_tilt_sd_rad))
    if as_json:
        table = {
            "trials": found.trials,
            "roll_yaw_tilt_sd_deg": [roll, yaw, tilt],
            "centre_sd_mm": found.centre_sd_mm,
            "corner_sd_mm": found.corner_sd_mm,
            "centre_shift_mm": None if found.centre_shift_mm is None else found.centre_shift_mm.tolist(),
        }
        emit_json(table)
        return
    emit(f"standard deviation over {found.trials} calibrations")
    emit(f"  roll {roll:.3f}, yaw {yaw:.3f}, tilt {tilt:.3f} deg")
    if found.centre_shift_mm is None:
        if size_px is None:
            note("with --size-px COLUMNS ROWS also the scatter of the image's centre and corners")
        return
    emit(f"  centre {found.centre_sd_mm:.3f} mm, corners {found.corner_sd_mm:.3f} mm")
    shifts = ", ".join(f"{shift:.2f}" for shift in found.centre_shift_mm)
    emit(f"centre against the first calibration: {shifts} mm")
