"""Calibration without a phantom, from two crossing sweeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from speckle3d.cli.calibrations import report_of
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    MaybeNumber,
    MaybePath,
    MaybeText,
    Out,
    Paths,
    PixelMm,
    Result,
)
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.progress import progress_bar

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform


Triple = tuple[float, float, float]


def images(
    first: Annotated[Path, typer.Argument(metavar="A")],
    second: Annotated[Path, typer.Argument(metavar="B")],
    out: Annotated[Out, "calibration"],
    *,
    start: MaybePath = None,
    start_mm: Triple | None = None,
    start_deg: Triple | None = None,
    poses: Paths = None,
    transform: MaybeText = None,
    pixel_mm: PixelMm = None,
    settings: Annotated[Any, Fields("calibration.settings:ImageFit")],
    time_offset_s: MaybeNumber = None,
) -> Result:
    """Calibrate a position sensor from two crossing sweeps of anything with visible structure.

    Parameters
    ----------
    first
        Tracked sweep: sweep file, MetaImage, NRRD.
    second
        Another of the same place, turned by 90 deg.
    out
        Calibration file to write; .txt and .png beside it.
    start
        Calibration to start from; by default A's own, if it has one. Not with --start-mm.
    start_mm
        With --start-deg: start by ruler, the image's top left corner seen from the sensor, x y z.
    start_deg
        With --start-mm: start by eye, turns from sensor to image, roll yaw tilt (fixed x, y, z of TR 303).
    as_json

    Other Parameters
    ----------------
    poses
        File with readings, if not in A and B; once for each.
    transform, pixel_mm
    time_offset_s
        The sensor's clock offset, in place of the files' own; see `speckle3d calibrate clock --by images`.

    Examples
    --------
    $ speckle3d calibrate images one.h5 across.h5 -o tracker.h5 --start rough.h5
    """
    import numpy as np

    from calibration.images.angulation import angulation
    from calibration.images.report import calibration_from_images, figure_of, notes_of
    from calibration.images.solver import calibrate_images
    from speckle3d.calibrating.recordings import open_recording
    from speckle3d.calibrating.written import write_with_report
    from speckle3d.io.calibrations import read_calibration

    if poses and len(poses) != 2:
        raise InvalidInputError(f"--poses: expected it twice, for A and for B, got {len(poses)}")
    calibration = None if start is None else read_calibration(start)
    if time_offset_s is None and calibration is not None:
        time_offset_s = calibration.time_offset_s
    a, b = (
        open_recording(images, poses, pixel_mm, "tracker", transform, np.nan)
        for images, poses in zip((first, second), poses or (None, None), strict=True)
    )
    if time_offset_s is not None:
        a, b = (replace(sweep, time_offset_s=time_offset_s) for sweep in (a, b))
    mounting = a.mounting if calibration is None else calibration.sensor_from_image
    begin = _start(start_mm, start_deg, mounting, first)
    # Half of the limits: a mounting that is off by 20 degrees is good enough for no more.
    poses_a, poses_b = (sweep.world_from_sensor(sweep.covered()) for sweep in (a, b))
    angulation(poses_a, poses_b, begin).require(0.5)
    with progress_bar("comparing sweeps") as bar:
        result = calibrate_images(a, b, begin, settings, bar)
    notes, answer = notes_of(result), calibration_from_images(result, (a, b))
    files = write_with_report(answer, (first, second), out, lambda _: figure_of(result, (a, b)), notes)
    return report_of(files, notes)


def _start(
    start_mm: Triple | None,
    start_deg: Triple | None,
    mounting: RigidTransform | None,
    first: Path,
) -> RigidTransform:
    """Mounting to start from: by ruler and eye, or that of a calibration or of the first sweep."""
    import numpy as np
    from scipy.spatial.transform import RigidTransform

    from speckle3d.core.geometry import rotation_from_fixed_angles

    if start_mm is not None and start_deg is not None:
        roll, yaw, tilt = np.deg2rad(start_deg)
        return RigidTransform.from_components(start_mm, rotation_from_fixed_angles(roll, yaw, tilt))
    if mounting is None:
        raise InsufficientDataError(
            f"{first}: expected a start, within 20 mm and 20 degrees: --start CAL.h5, or --start-mm X Y Z "
            "with --start-deg ROLL YAW TILT; got none"
        )
    return mounting
