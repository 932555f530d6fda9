"""The delay between images and a sensor."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from speckle3d.cli.common import Json, calibrate, emit, note
from speckle3d.cli.phantoms import Images, PixelMm, Poses, Region, find_lines
from speckle3d.core.errors import InvalidInputError, naming


@calibrate.command("clock")
def calibrate_clock(
    images: Images,
    poses: Poses = None,
    pixel_mm: PixelMm = None,
    sensor: Annotated[str, typer.Option(help="tracker or orientation.")] = "tracker",
    region: Region = None,
    search_s: Annotated[float, typer.Option(min=0.02, help="Delays to either side of the file's own.")] = 0.5,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file to copy, with the clock offset that was found.")
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--output", help="Where that copy goes.")] = None,
    as_json: Json = False,
) -> None:
    """Find a sensor's clock offset from a plane's line while the probe goes up and down (or rolls)."""
    from calibration.clock import delay_from_lines, line_signal
    from speckle3d.cli.recordings import open_recording
    from speckle3d.io.calibrations import read_calibration, write_calibration

    if (calibration is None) != (out is None):
        raise InvalidInputError("expected --calibration and -o together, or neither")
    known = None if calibration is None else read_calibration(calibration)
    recording = open_recording(images, poses, pixel_mm, sensor)
    seen = find_lines(recording, region, images)
    with naming(str(images)):
        signal = line_signal(seen.marks_px, recording.pixel_mm, (recording.images.shape[1] - 1) / 2)
        times = recording.frame_time_s[seen.frame]
        found = delay_from_lines(signal, times, recording.readings, recording.time_offset_s, search_s)
    if known is not None and out is not None:
        write_calibration(out, replace(known, time_offset_s=found.seconds))
        note(f"calibration with this offset in {out}")
    if as_json:
        table = {"time_offset_s": found.seconds, "standard_error_s": found.standard_error_s}
        emit(json.dumps(table | {"followed": found.followed, "frames": len(seen.frame)}, indent=2))
        return
    emit(f"sensor clock offset  {found.seconds:+.4f} +- {found.standard_error_s:.4f} s")
    emit(f"the sensor explains {100 * found.followed:.0f} % of the line's motion in {len(seen.frame)} frames")
