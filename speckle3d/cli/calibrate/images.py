"""Calibration from images of anything: a mounting from two crossing sweeps, and a sensor's clock offset."""

from dataclasses import replace
from math import nan
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import speckle3d as s3
from speckle3d.cli.commands import Fields
from speckle3d.cli.common import (
    MaybeNumber,
    MaybePath,
    MaybeText,
    OptionalOut,
    Out,
    Paths,
    PixelMm,
    Result,
    note,
    report_of,
)
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError, naming

Triple = tuple[float, float, float]


def images(
    first: Path,
    second: Path,
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
        Calibration to start from; by default FIRST's own, if it has one. Not with --start-mm.
    start_mm
        With --start-deg: start by ruler, the image's top left corner seen from the sensor, x y z.
    start_deg
        With --start-mm: start by eye, turns from sensor to image, roll yaw tilt (fixed x, y, z of TR 303).
    as_json

    Other Parameters
    ----------------
    poses
        File with readings, if not in FIRST and SECOND; once for each.
    transform, pixel_mm
    time_offset_s
        The sensor's clock offset, in place of the files' own; see `speckle3d calibrate clock --by images`.

    Examples
    --------
    $ speckle3d calibrate images one.h5 across.h5 -o tracker.h5 --start rough.h5
    """
    import numpy as np
    from scipy.spatial.transform import RigidTransform

    from calibration.images.angulation import angulation
    from calibration.images.report import calibration_from_images, figure_of, notes_of
    from calibration.images.similarity import prepare
    from calibration.images.solver import calibrate_images
    from speckle3d.calibrating.recordings import open_recording
    from speckle3d.calibrating.written import write_with_report
    from speckle3d.core.geometry import rotation_from_fixed_angles

    if poses and len(poses) != 2:
        raise InvalidInputError(f"--poses: expected it twice, for FIRST and SECOND, got {len(poses)}")
    calibration = None if start is None else s3.load_calibration(start)
    if time_offset_s is None and calibration is not None:
        time_offset_s = calibration.time_offset_s
    a, b = (
        open_recording(images, poses, pixel_mm, "tracker", transform, np.nan)
        for images, poses in zip((first, second), poses or (None, None), strict=True)
    )
    if time_offset_s is not None:
        a, b = (replace(sweep, time_offset_s=time_offset_s) for sweep in (a, b))
    mounting = a.mounting if calibration is None else calibration.sensor_from_image
    if start_mm is not None and start_deg is not None:
        roll, yaw, tilt = np.deg2rad(start_deg)
        turn = rotation_from_fixed_angles(roll, yaw, tilt)
        mounting = RigidTransform.from_components(start_mm, turn)
    if mounting is None:
        raise InsufficientDataError(
            f"{first}: expected a start, within 20 mm and 20 degrees: --start CAL.h5, or --start-mm X Y Z "
            "with --start-deg ROLL YAW TILT; got none"
        )
    # Half of the limits: a mounting that is off by 20 degrees is good enough for no more.
    poses_a, poses_b = (sweep.world_from_sensor(sweep.covered()) for sweep in (a, b))
    angulation(poses_a, poses_b, mounting).require(0.5)
    with s3.progress_bar("comparing sweeps") as bar:
        result = calibrate_images(prepare(a, b, bar), mounting, settings, bar)
    notes, answer = notes_of(result), calibration_from_images(result, (a, b))
    files = write_with_report(answer, (first, second), out, figure_of(result, (a, b)), notes)
    return report_of(files, notes)


_SCAN = ("poses", "transform", "pixel_mm", "region")


def clock(
    images: Path,
    scan: Annotated[Any, Fields("speckle3d.calibrating.settings:ScanSettings", _SCAN)],
    by: Literal["line", "images"] = "line",
    sensor: Literal["tracker", "orientation"] = "tracker",
    search_s: Annotated[float, typer.Option(min=0.02)] = 0.5,
    calibration: MaybePath = None,
    out: Annotated[OptionalOut, "calibration"] = None,
) -> Result:
    """Find a sensor's clock offset: a motion forward and back, or up and down (or rolling) over a plane.

    The offset is added to the sensor's times; PLUS's LocalTimeOffsetSec, of the image device, is the same
    with the other sign.

    Parameters
    ----------
    images
    by
        line: a plane's echo follows the sensor; images: a sweep forward and back over tissue.
    calibration
        Calibration to start from (images), and to copy with the offset that was found.
    out
        With --calibration: where that copy goes.
    search_s
        Delays to either side of the file's own.
    poses, transform, as_json

    Other Parameters
    ----------------
    pixel_mm
    sensor
        line: whose clock.
    region

    Examples
    --------
    $ speckle3d calibrate clock bath.h5 --calibration tracker.h5 -o timed.h5
    """
    from calibration.clock.images import delay_from_images
    from calibration.clock.line import delay_from_lines, line_signal
    from calibration.detection.lines import detect_lines
    from calibration.settings import ImageFit
    from speckle3d.calibrating.recordings import open_recording

    if by == "images" and sensor != "tracker":
        raise InvalidInputError(f"--by images: expected --sensor tracker, which knows places, got {sensor}")
    start = None if calibration is None else s3.load_calibration(calibration)
    if start is not None and start.sensor != sensor:
        raise MismatchError(
            f"{calibration}: expected a calibration of the {sensor}, got one of {start.sensor}"
        )
    outside = nan if by == "images" else 0.0
    recording = open_recording(images, scan.poses, scan.pixel_mm, sensor, scan.transform, outside)
    if by == "images":
        if start is not None:
            offset_s = recording.time_offset_s if start.time_offset_s is None else start.time_offset_s
            recording = replace(recording, mounting=start.sensor_from_image, time_offset_s=offset_s)
        if recording.mounting is None:
            raise InsufficientDataError(
                f"{images}: expected --calibration, how the image sits on the sensor, at least roughly; "
                "got none"
            )
        with s3.progress_bar("trying delays") as progress, naming(str(images)):
            delay = delay_from_images(recording, recording.mounting, search_s, progress=progress)
        frames = len(recording.frame_time_s)
        words = (
            f"images of the way forward correlate by {delay.followed:.2f} with those of the way back\n"
            f"in the error: {ImageFit().tracker_mm:g} mm by which tracker or tissue may differ between them; "
            "faster, it counts less"
        )
    else:
        times, columns = recording.frame_time_s, recording.images.shape[1]
        with s3.progress_bar(f"finding lines in {images.name}") as progress, naming(str(images)):
            lines = detect_lines(recording.images, recording.pixel_mm, None, scan.corners, progress)
            frames = len(lines)
            signal = line_signal(lines.pixels, recording.pixel_mm, (columns - 1) / 2)
            readings, around_s = recording.readings, recording.time_offset_s
            delay = delay_from_lines(signal, times[lines.frame], readings, around_s, search_s)
        words = f"the sensor explains {100 * delay.followed:.0f} % of the line's motion in {frames} frames"
    if start is not None and out is not None:
        s3.write_calibration(out, replace(start, time_offset_s=delay.seconds))
        note(f"calibration with this offset in {out}")
    error_s = delay.standard_error_s
    offset = {"time_offset_s": delay.seconds, "standard_error_s": error_s}
    numbers = offset | {"followed": delay.followed, "frames": frames}
    return numbers, f"sensor clock offset  {delay.seconds:+.4f} +- {1.96 * error_s:.4f} s (95 %)\n{words}"
