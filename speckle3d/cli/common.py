"""Options, settings and output common to commands, and calibrations of a sweep."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import speckle3d as s3
from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.text import printable

if TYPE_CHECKING:
    from calibration.beam import BeamBias
    from speckle3d.calibrating.written import Written
    from speckle3d.core.grid import ImageGrid


class Drift(StrEnum):
    """A mode of a reconstruction beside `image`."""

    ORIENTATION = "orientation"
    POSE = "pose"
    FUSED = "fused"
    CROSSED = "crossed"
    CONSISTENT_SUBSET = "consistent-subset"


Reference = Literal["tracker", "truth"]
MaybePath = Path | None
MaybeText = str | None
MaybeNumber = float | None
Paths = list[Path] | None
Sweeps = Annotated[Paths, typer.Argument(metavar="SWEEP")]
Port = Annotated[int, typer.Option(min=0, max=65535)]
Out = Annotated[Path, typer.Option("-o", "--output", writable=True)]
OptionalOut = Annotated[MaybePath, typer.Option("-o", "--output", writable=True)]
OutArgument = Annotated[Path, typer.Argument(writable=True)]
WritablePath = Annotated[MaybePath, typer.Option(writable=True)]
PixelMm = tuple[float, float] | None
Json = Annotated[bool, typer.Option("--json")]
Result = tuple[Any, str]
"""What a command prints: numbers for --json, else text."""


def common_options() -> None:
    """Options that mean the same in every command that has them.

    Parameters
    ----------
    as_json
        Print machine-readable results on stdout.
    config_file
        TOML with settings to change; see `speckle3d config`.
    calibration
        Calibration to use for its sensor in place of the file's; may be repeated.
    curves_file
        Decorrelation curves; by default curves.h5 beside SWEEP.
    images
        Recording: a sweep file, an image sequence, a scanner's package.
    input_file
        A results folder or its reconstruction.h5, or a recording with a calibrated tracker or true poses.
    reconstruction_file
        A results folder, or its reconstruction.h5.
    log_file
        A log of the sensor, of any kind that is known, or a sweep with one. A plain CSV has the columns
        time_s, accelerometer_x_m_s2, gyroscope_x_rad_s, magnetometer_x_au (y and z likewise), quaternion_w to
        _z.
    magnetometer
        Let the magnetic field tell the heading.
    method
        smoother: from all of the log; filter: as it would be live; vqf, vqf-online: the same by VQF (Laidig
        and Seel 2023); sensor: the sensor's own.
    rate_hz
        Samples per second, for logs that do not say.
    world
        World of the sensor's own orientation (east, north, up and so on); by default as its accelerometer and
        magnetometer show.
    mode
        Which poses to use: image, orientation, pose, crossed, fused, consistent-subset of a reconstruction
        (by default those that claim the smallest error of length); tracker, truth of a recording.
    pixel_mm
        Distance between columns and rows, mm, if IMAGES does not say.
    poses
        File with the sensor's readings, if not in IMAGES.
    region
        Part of the images that counts, in mm and degrees: 'rectangle x,y x,y', 'polygon x,y x,y x,y ...' or
        'fan x,y angle,angle radius,radius'; several joined by ' and '.
    sweep_file
        The sweep, if it moved since the reconstruction.
    transform, tracker_transform
        Poses to use, by their name in an image sequence, as ToolToTracker (ProbeToTracker).
    """


def note(*lines: str | None) -> None:
    """Print remarks on stderr, a line each, apart from the results; what they quote is shown escaped."""
    for line in filter(None, lines):
        sys.stderr.write(f"{printable(line)}\n")


def emit(text: str) -> None:
    """Print results on stdout; but for line breaks, characters that drive a terminal are shown escaped."""
    text = printable(text, kept="\n")
    try:
        sys.stdout.write(text if text.endswith("\n") else text + "\n")
        sys.stdout.flush()
    except OSError as error:
        raise FileError(f"standard output: cannot be written: {error.strerror}") from error


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """A line on a terminal's stderr that is written anew at every call, and goes at the end of the block."""
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    # A status of rich's would wrap where the terminal is narrow.
    with Live(console=Console(stderr=True), transient=True) as line:
        yield lambda text: line.update(Text(printable(text), no_wrap=True, overflow="ellipsis"))


def rows_of(rows: Sequence[tuple[str, Any, str]]) -> Result:
    """Rows of description, value and unit, for JSON and aligned."""
    from speckle3d.core.text import text_rows

    return [{"description": d, "value": v, "unit": u} for d, v, u in rows], text_rows(rows)


def part_of(sweep: s3.Sweep, frames: str | None, option: str) -> s3.Sweep:
    """Frames FIRST-LAST of a sweep; by default all."""
    if frames is None:
        return sweep
    match = re.fullmatch("([0-9]+)-([0-9]+)", frames)
    if match is None:
        raise InvalidInputError(f"{option}: expected FIRST-LAST, two frame numbers, got {frames!r}")
    return sweep.part(int(match[1]), int(match[2]) + 1)


NOTED_DEG, NOTED_MM = 5.0, 10.0
"""Difference of mountings that is reported: calibrations of one mounting differ by less."""


def report_of(written: Written, notes: Sequence[str], beam: Sequence[BeamBias] = ()) -> Result:
    """Table of a calibration that was written; its place is noted on stderr."""
    from calibration.report import json_report

    out, text, pictures = written.files
    note(f"calibration in {out}, report in {text} and {pictures}")
    return json_report(written.calibration, beam) | {"notes": notes}, written.table


def clip_of(config: str | None, grid: ImageGrid, skew_rad: float) -> str | None:
    """Region to which a device set of PLUS clips volumes."""
    from speckle3d.io.plus.device_set import read_device_set

    return None if config is None else read_device_set(config).clip_region(replace(grid, skew_rad=skew_rad))


def mount(sweep: s3.Sweep, paths: Sequence[Path]) -> s3.Sweep:
    """Put calibration files on a sweep's sensors, and report on stderr where they contradict the sweep."""
    import numpy as np

    from speckle3d.calibration_files import apply_calibrations
    from speckle3d.core.geometry import rigid

    for path in paths:
        calibration = s3.load_calibration(path)
        mounting = getattr(getattr(sweep, calibration.sensor), "sensor_from_image", None)
        if mounting is None:
            continue
        step = rigid(mounting).inv() * rigid(calibration.mounting)
        angle_deg, shift_mm = np.rad2deg(step.rotation.magnitude()), np.linalg.norm(step.translation)
        if angle_deg > NOTED_DEG or shift_mm > NOTED_MM:
            shift = f" and {shift_mm:.0f} mm" if calibration.sensor == "tracker" else ""
            note(
                f"{path}: puts the image {angle_deg:.0f} degrees{shift} from where the sweep has it on the "
                f"{calibration.sensor} sensor, and is used: is it of this mounting?"
            )
    return apply_calibrations(sweep, paths)[0]
