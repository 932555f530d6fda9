"""Calibration without a phantom, from two crossing sweeps."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.calibrations import report_written, require_free
from speckle3d.cli.common import CalibrationOut, Json, PixelMm, Transform, calibrate, from_options, note
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, naming
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform

    from calibration.images.angulation import Angulation
    from calibration.images.solver import ImageCalibration
    from calibration.images.stacks import TrackedImages
    from calibration.settings import ImageFit
    from speckle3d.core.calibration import Calibration


_FAR_MM = 300.0
"""Largest distance of an image from a sensor on the same probe."""

MOST_OFFSET_S = 1e6
"""Largest clock offset, s: clocks that start at switching on and at midnight differ by less."""


@calibrate.command("images")
def calibrate_images(
    first: Annotated[Path, typer.Argument(metavar="A", help="Tracked sweep: sweep file, MetaImage, NRRD.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another of the same place, turned by 90 deg.")],
    out: CalibrationOut,
    start: Annotated[
        Path | None, typer.Option(help="Calibration to start from; by default A's own, if it has one.")
    ] = None,
    start_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Start by ruler: the image's top left corner seen from the sensor, x y z."),
    ] = None,
    start_deg: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="Start by eye: turns from sensor to image, roll yaw tilt (fixed x, y, z of TR 303)."
        ),
    ] = None,
    poses: Annotated[
        list[Path] | None, typer.Option(help="File with readings, if not in A and B; once for each.")
    ] = None,
    transform: Transform = None,
    pixel_mm: PixelMm = None,
    method: Annotated[str | None, typer.Option(help="Was removed; there is one optimiser.")] = None,
    scales: Annotated[bool, typer.Option("--scales", help="Estimate the pixel size too.")] = False,
    capture_mm: Annotated[float, typer.Option(help="How far the start may be off, each way.")] = 20.0,
    capture_deg: Annotated[float, typer.Option(help="The same for its turns.")] = 20.0,
    tracker_mm: Annotated[
        float, typer.Option(help="What the tracker may displace one sweep against the other by, each way.")
    ] = 0.15,
    tracker_deg: Annotated[float, typer.Option(help="The same for turns.")] = 0.1,
    clock: Annotated[
        Path | None,
        typer.Option(help="Sweep forward and back: solve, find the clock offset from it, solve again."),
    ] = None,
    time_offset_s: Annotated[
        float | None, typer.Option(help="The sensor's clock offset, in place of the files' own.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Calibrate a position sensor from two crossing sweeps of anything with visible structure."""
    from calibration.clock.images import delay_from_images
    from calibration.images.report import calibration_from_images, figure_of, notes_of
    from calibration.settings import ImageFit
    from speckle3d.calibrating.recordings import open_tracked, require_unsized
    from speckle3d.calibrating.written import write_with_report
    from speckle3d.io.calibrations import read_calibration

    if time_offset_s is not None and not abs(time_offset_s) < MOST_OFFSET_S:
        raise InvalidInputError(f"--time-offset-s: expected seconds, few of them, got {time_offset_s}")
    if method not in (None, "gauss-newton"):
        raise InvalidInputError("--method: was removed; the search by derivatives finds what Nelder-Mead did")
    readings = _one_each(poses)
    require_free(out, first, second, start, clock, *(poses or ()))
    settings = from_options(ImageFit, locals())
    for path in (first, second):
        require_unsized(path, pixel_mm)
    known = None if start is None else read_calibration(start)
    offset_s = known.time_offset_s if time_offset_s is None and known is not None else time_offset_s
    one, mounting = open_tracked(first, readings[0], pixel_mm, offset_s, transform)
    other, _ = open_tracked(second, readings[1], pixel_mm, offset_s, transform)
    back = None if clock is None else open_tracked(clock, None, pixel_mm, offset_s, transform)[0]
    begin = _start(known, start_mm, start_deg, mounting, first)
    if (far := math.hypot(*begin.translation)) > _FAR_MM:
        note(f"the start puts the image {far:.0f} mm from the sensor: is that so?")
    sweeps = one, other
    # Half of the limits: a mounting that is off by 20 degrees is good enough for no more.
    _angulation(sweeps, begin).require(0.5)
    found = _solve(sweeps, begin, settings)
    told = []
    if back is not None:
        with progress_bar("trying delays") as progress, naming(str(clock)):
            delay = delay_from_images(back, found.sensor_from_image, progress=progress)
        said = f"clock offset {delay.seconds:+.4f} +- {delay.standard_error_s:.4f} s"
        note(f"sensor {said}; solving again")
        told.append(f"{said}, from images")
        sweeps = replace(one, time_offset_s=delay.seconds), replace(other, time_offset_s=delay.seconds)
        found = _solve(sweeps, found.sensor_from_image, settings)
    if not found.converged:
        raise InsufficientDataError(
            f"{first.name} and {second.name}: the solution did not converge: expected a better start, or "
            "longer sweeps with more structure; nothing is written"
        )
    # Checked again at the answer, because the overlap of the sweeps depends on the mounting.
    enough = _angulation(sweeps, found.sensor_from_image)
    notes = notes_of(found, enough) + told
    made = calibration_from_images(found, enough, sweeps)
    written = write_with_report(made, (first, second), out, lambda _: figure_of(found, enough, sweeps), notes)
    report_written(written, notes, as_json=as_json)


def _one_each(poses: list[Path] | None) -> list[Path | None]:
    if poses is None or not poses:
        return [None, None]
    if len(poses) != 2:
        raise InvalidInputError(f"--poses: expected it twice, for A and for B, got {len(poses)}")
    return list(poses)


def _start(
    known: Calibration | None,
    start_mm: tuple[float, float, float] | None,
    start_deg: tuple[float, float, float] | None,
    mounting: RigidTransform | None,
    first: Path,
) -> RigidTransform:
    import numpy as np
    from scipy.spatial.transform import RigidTransform

    from speckle3d.core.geometry import rotation_from_fixed_angles

    by_ruler = start_mm is not None or start_deg is not None
    if by_ruler and known is not None:
        raise InvalidInputError("expected --start or --start-mm with --start-deg, got both")
    if by_ruler:
        if start_mm is None or start_deg is None:
            raise InvalidInputError("expected --start-mm and --start-deg together, got one of them")
        for option, given in (("--start-mm", start_mm), ("--start-deg", start_deg)):
            if not np.isfinite(given).all():
                raise InvalidInputError(f"{option}: expected three finite numbers, got {given}")
        roll, yaw, tilt = np.deg2rad(start_deg)
        return RigidTransform.from_components(start_mm, rotation_from_fixed_angles(roll, yaw, tilt))
    if known is not None:
        return known.sensor_from_image
    if mounting is None:
        raise InsufficientDataError(
            f"{first}: expected a start, within 20 mm and 20 degrees: --start CAL.h5, or --start-mm X Y Z "
            "with --start-deg ROLL YAW TILT; got none"
        )
    return mounting


def _angulation(sweeps: tuple[TrackedImages, TrackedImages], start: RigidTransform) -> Angulation:
    from calibration.images.angulation import angulation

    posed = [each.world_from_sensor(each.covered()) for each in sweeps]
    return angulation(posed[0], posed[1], start, sweeps[0].grid.corners_mm)


def _solve(
    sweeps: tuple[TrackedImages, TrackedImages], start: RigidTransform, settings: ImageFit
) -> ImageCalibration:
    from calibration.images.solver import calibrate_images as solve

    with progress_bar("comparing sweeps") as bar:
        return solve(*sweeps, start, settings, lambda _stage, done, of: bar(done, of))
