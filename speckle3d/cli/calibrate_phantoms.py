"""Calibration of a sensor to the image with a phantom, a plane or wires, and how calibrations repeat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from speckle3d.cli.calibrations import require_free, write_with_report
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
    progress_bar,
)
from speckle3d.core.errors import InvalidInputError, naming

if TYPE_CHECKING:
    from calibration.chain import ImagePoints, Seen
    from calibration.detection.lines import LineSettings
    from calibration.job import JobSettings, Outcome, Recording
    from speckle3d.core.arrays import FloatArray

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
    time_offset: TimeOffset = None,
    outlier_sigma: OutlierSigma = 4.0,
    validation: Validation = None,
    columns: Columns = None,
    smoothing_mm: SmoothingMm = None,
    threshold: Threshold = None,
    tolerance_mm: ToleranceMm = None,
    consensus: Consensus = None,
    place: Place = None,
    as_json: Json = False,
) -> None:
    """Calibrate a position sensor with the floor of a water bath, or the Cambridge phantom."""
    from calibration.detection.lines import LineSettings
    from calibration.job import plane_job

    require_free(out, images, poses, validation)
    lines = from_options(LineSettings, locals())
    widths = () if reflector == "bar" else tuple(beam_mm or (1.0, 2.0, 3.0))

    def scan(path: Path, readings: Path | None) -> tuple[Recording, Seen, JobSettings]:
        recording, job = _prepared(path, readings, pixel_mm, "tracker", time_offset, outlier_sigma, transform)
        return recording, find_lines(recording, region, path, lines), job

    solve = partial(
        plane_job, fit_pixels=not fixed_pixels, stages=stages, beam_mm=widths, pixel_error=pixel_error
    )
    _calibrate(scan, solve, images, poses, validation, out, as_json)


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
        str, typer.Option(help="orientation, or tracker: use only what a tracker says of orientation.")
    ] = "orientation",
    region: Region = None,
    time_offset: TimeOffset = None,
    outlier_sigma: OutlierSigma = 4.0,
    validation: Validation = None,
    columns: Columns = None,
    smoothing_mm: SmoothingMm = None,
    threshold: Threshold = None,
    tolerance_mm: ToleranceMm = None,
    consensus: Consensus = None,
    place: Place = None,
    as_json: Json = False,
) -> None:
    """Calibrate an orientation sensor with the floor of a water bath; gravity tells the mirror image."""
    from calibration.detection.lines import LineSettings
    from calibration.job import orientation_job

    require_free(out, images, poses, validation)
    lines = from_options(LineSettings, locals())

    def scan(path: Path, readings: Path | None) -> tuple[Recording, Seen, JobSettings]:
        recording, job = _prepared(path, readings, pixel_mm, sensor, time_offset, outlier_sigma, transform)
        return recording, find_lines(recording, region, path, lines), job

    solve = partial(orientation_job, level=level, viewed_from=viewed_from)
    _calibrate(scan, solve, images, poses, validation, out, as_json)


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
    region: Region = None,
    time_offset: TimeOffset = None,
    outlier_sigma: OutlierSigma = 4.0,
    validation: Validation = None,
    validation_points: Annotated[
        Path | None, typer.Option(help="CSV of points picked by hand in that other recording.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Calibrate a position sensor with crossing wires, three orthogonal wires or N-shapes."""
    from calibration.job import wires_job
    from speckle3d.core.wires import three_wires
    from speckle3d.io.plus_config import WireConfig, read_wire_phantom

    if validation is None and validation_points is not None:
        raise InvalidInputError("--validation-points: expected the recording in --validation, got none")
    require_free(out, images, points, poses, validation, validation_points, Path(phantom))
    config: WireConfig | None = None
    if phantom not in ("cross", "three"):
        config = read_wire_phantom(phantom)
        if pixel_mm is None and config.pixel_mm is not None:
            pixel_mm = (config.pixel_mm, config.pixel_mm)
    geometry = config.phantom if config else three_wires() if phantom == "three" else None

    def scan(path: Path, readings: Path | None) -> tuple[Recording, Seen, JobSettings]:
        recording, job = _prepared(path, readings, pixel_mm, "tracker", time_offset, outlier_sigma, transform)
        picked = validation_points if path is validation else points
        return recording, _seen_wires(recording, phantom, config, picked, region, path), job

    fit_pixels = not fixed_pixels
    solve = partial(wires_job, phantom=geometry, fit_pixels=fit_pixels, registration=registration)
    names = () if config is None else config.phantom.names
    _calibrate(scan, solve, images, poses, validation, out, as_json, names)


def _calibrate(
    scan: Callable[[Path, Path | None], tuple[Recording, Seen, JobSettings]],
    solve: Callable[[Recording, Seen, JobSettings], Outcome],
    images: Path,
    poses: Path | None,
    validation: Path | None,
    out: Path,
    as_json: bool,
    wire_names: tuple[str, ...] = (),
) -> None:
    """Calibrate, check on the other recording, and write the calibration, its report and the dots."""
    from calibration.report import figure_report
    from speckle3d.io.points import PickedPoints, write_points

    recording, seen, job = scan(images, poses)
    with naming(str(images)):
        outcome = solve(recording, seen, job)
    notes = [] if outcome.choice is None else [str(outcome.choice)]
    notes += _nwire_notes(outcome, outcome.solution.points)
    if (found := outcome.offset) is not None:
        notes.insert(0, f"clock offset {found.seconds:+.4f} +- {found.standard_error_s:.4f} s, estimated")
    if validation is not None:
        other, other_seen, _ = scan(validation, None)
        notes += _validated(outcome, other, other_seen, validation)

    def write_dots(path: Path) -> None:
        found = outcome.seen
        write_points(path, PickedPoints(found.frame, found.pixels, found.wire), wire_names)

    write_with_report(
        outcome.calibration,
        [images],
        out,
        lambda calibration: figure_report(outcome.solution, calibration, outcome.shots),
        notes,
        outcome.beam,
        as_json,
        None if seen.are_lines else write_dots,
    )


def _prepared(
    images: Path,
    poses: Path | None,
    pixel_mm: tuple[float, float] | None,
    sensor: str,
    time_offset: str | None,
    outlier_sigma: float,
    transform: str | None,
) -> tuple[Recording, JobSettings]:
    from calibration.job import JobSettings
    from speckle3d.cli.recordings import open_recording

    recording = open_recording(images, poses, pixel_mm, sensor, transform)
    if time_offset is None:
        return recording, JobSettings(outlier_sigma=outlier_sigma)
    if time_offset == "estimate":
        return recording, JobSettings(outlier_sigma=outlier_sigma, estimate_offset=True)
    return replace(recording, time_offset_s=_seconds(time_offset)), JobSettings(
        outlier_sigma=outlier_sigma, offset_given=True
    )


def _seconds(text: str) -> float:
    from speckle3d.io.text import numbers

    try:
        (seconds,) = numbers(text, 1, "--time-offset")
    except InvalidInputError:
        raise InvalidInputError(f"--time-offset: expected seconds or `estimate`, got {text!r}") from None
    return seconds


def _region(text: str | None) -> FloatArray | None:
    """Parse the polygon "column,row column,row ..."; shape (k, 2)."""
    import numpy as np

    if text is None:
        return None
    try:
        corners = np.array([[float(x) for x in corner.split(",")] for corner in text.split()])
    except ValueError:
        corners = np.empty(0)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise InvalidInputError(f'--region: expected at least three "column,row", got {text!r}')
    return corners


def find_lines(
    recording: Recording, region: str | None, images: Path, settings: LineSettings | None = None
) -> Seen:
    """Find the plane's line in every image, showing progress."""
    from calibration.detection.lines import detect_lines

    corners = _region(region)
    with progress_bar(f"finding lines in {images.name}") as progress, naming(str(images)):
        return detect_lines(recording.images, recording.pixel_mm, settings, corners, progress)


def _seen_wires(
    recording: Recording, phantom: str, config: Any, points: Path | None, region: str | None, images: Path
) -> Seen:
    from calibration.chain import Seen
    from calibration.job import find_crossings, find_nwires
    from speckle3d.io.points import read_points

    names = ("x", "y", "z") if phantom == "three" else () if config is None else config.phantom.names
    if points is not None:
        picked = read_points(points, names)
        with naming(str(points)):
            picked.require_inside(recording.images.shape)
        return Seen(picked.frame, picked.pixels, picked.wire)
    if phantom == "three":
        raise InvalidInputError(
            "--phantom three: expected --points (of --validation: --validation-points), a CSV that says on "
            "which wire each dot lies, got none"
        )
    corners = _region(region)
    with progress_bar(f"finding dots in {images.name}") as progress, naming(str(images)):
        if config is None:
            return find_crossings(recording, corners, progress)
        clip = config.clip_px if corners is None else corners
        return find_nwires(recording, config.phantom, clip, progress)


def _validated(outcome: Outcome, other: Recording, seen: Seen, path: Path) -> list[str]:
    from calibration.job import choose_crossings, paired
    from calibration.repeatability import validate
    from calibration.wires import CrossWire
    from speckle3d.core.calibration import readable

    found = outcome.calibration.time_offset_s
    offset_s = other.time_offset_s if found is None else found
    with naming(str(path)):
        if isinstance(outcome.solution.phantom, CrossWire):
            seen = choose_crossings(other, seen, [offset_s])
        points, _ = paired(other, seen, offset_s)
        residuals = validate(outcome.solution, points)
    frames = len(set(points.frame.tolist()))
    rms, unit = readable(float((residuals**2).mean() ** 0.5), outcome.calibration.rms_unit)
    notes = [f"on {path.name}, not used: RMS residual {rms} {unit}, {frames} frames, none left out"]
    return notes + [f"on {path.name}: {text}" for text in _nwire_notes(outcome, points)]


def _nwire_notes(outcome: Outcome, points: ImagePoints) -> list[str]:
    """Report PLUS's 3-D error, if the phantom has N-shapes."""
    from calibration.nwires import nwire_errors_mm, pixel_matrix, trimmed_mean_mm
    from calibration.wires import Wires

    chain, phantom = outcome.solution.chain, outcome.solution.phantom
    if not isinstance(phantom, Wires) or not phantom.geometry.n_shapes:
        return []
    place = chain.target_from_world.inv()
    mean, sd = trimmed_mean_mm(nwire_errors_mm(points, phantom.geometry, pixel_matrix(chain), place))
    return [f"3-D error of the middle wires {mean:.3f} +- {sd:.3f} mm (the least 95 %, as PLUS has it)"]


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
