"""Calibration of a sensor's clock offset."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from pathlib import Path
from typing import Annotated, Literal

import typer

from speckle3d.cli.common import MaybePath, MaybeText, OptionalOut, PixelMm, Result, note
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError, naming
from speckle3d.core.progress import progress_bar


def clock(
    images: Path,
    poses: MaybePath = None,
    transform: MaybeText = None,
    pixel_mm: PixelMm = None,
    by: Literal["line", "images"] = "line",
    sensor: Literal["tracker", "orientation"] = "tracker",
    region: MaybeText = None,
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
        Polygon "column,row column,row ..." outside which nothing counts.

    Examples
    --------
    $ speckle3d calibrate clock bath.h5 --calibration tracker.h5 -o timed.h5
    """
    from calibration.clock.images import delay_from_images
    from calibration.clock.line import FEWEST_FRAMES, delay_from_lines, line_signal
    from calibration.detection.lines import detect_lines
    from speckle3d.calibrating.recordings import open_recording
    from speckle3d.calibrating.settings import region_of
    from speckle3d.io.calibrations import read_calibration, write_calibration

    if by == "images" and sensor != "tracker":
        raise InvalidInputError(f"--by images: expected --sensor tracker, which knows places, got {sensor}")
    start = None if calibration is None else read_calibration(calibration)
    if start is not None and start.sensor != sensor:
        raise MismatchError(
            f"{calibration}: expected a calibration of the {sensor}, got one of {start.sensor}"
        )
    outside = nan if by == "images" else 0.0
    recording = open_recording(images, poses, pixel_mm, sensor, transform, outside)
    if by == "images":
        mounting = recording.mounting
        if start is not None:
            mounting, offset_s = start.sensor_from_image, start.time_offset_s
            recording = recording if offset_s is None else replace(recording, time_offset_s=offset_s)
        if mounting is None:
            raise InsufficientDataError(
                f"{images}: expected --calibration, how the image sits on the sensor, at least roughly; "
                "got none"
            )
        with progress_bar("trying delays") as progress, naming(str(images)):
            delay = delay_from_images(recording, mounting, search_s, progress=progress)
        frames = len(recording.frame_time_s)
        words = f"images of the way forward correlate by {delay.followed:.2f} with those of the way back"
    else:
        with naming("--region"):
            corners = region_of(region or "")
        times, columns = recording.frame_time_s, recording.images.shape[1]
        with progress_bar(f"finding lines in {images.name}") as progress, naming(str(images)):
            lines = detect_lines(recording.images, recording.pixel_mm, None, corners, progress)
            frames = len(lines)
            if frames < FEWEST_FRAMES:
                raise InsufficientDataError(
                    f"expected a line in at least {FEWEST_FRAMES} frames, got one in {frames} of "
                    f"{len(times)}: record a plane's echo, for longer; of tissue use --by images"
                )
            signal = line_signal(lines.pixels, recording.pixel_mm, (columns - 1) / 2)
            readings, around_s = recording.readings, recording.time_offset_s
            delay = delay_from_lines(signal, times[lines.frame], readings, around_s, search_s)
        words = f"the sensor explains {100 * delay.followed:.0f} % of the line's motion in {frames} frames"
    if start is not None and out is not None:
        write_calibration(out, replace(start, time_offset_s=delay.seconds))
        note(f"calibration with this offset in {out}")
    error_s = delay.standard_error_s
    offset = {"time_offset_s": delay.seconds, "standard_error_s": error_s}
    numbers = offset | {"followed": delay.followed, "frames": frames}
    return numbers, f"sensor clock offset  {delay.seconds:+.4f} +- {1.96 * error_s:.4f} s (95 %)\n{words}"
