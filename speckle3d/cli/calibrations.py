"""Calibrations on the command line: where they may be written, and putting them on a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from speckle3d.cli.common import Result, note

if TYPE_CHECKING:
    from calibration.beam import BeamBias
    from speckle3d.calibrating.written import Written
    from speckle3d.core.grid import ImageGrid
    from speckle3d.core.sweep import Sweep

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


def mount(sweep: Sweep, paths: Sequence[Path]) -> Sweep:
    """Put calibration files on a sweep's sensors, and report on stderr where they contradict the sweep."""
    from speckle3d.core.calibration import mounting_difference
    from speckle3d.io.calibrations import apply_calibrations, read_calibration

    for path in paths:
        calibration = read_calibration(path)
        angle_deg, shift_mm = mounting_difference(sweep, calibration)
        if angle_deg > NOTED_DEG or shift_mm > NOTED_MM:
            shift = f" and {shift_mm:.0f} mm" if calibration.sensor == "tracker" else ""
            note(
                f"{path}: puts the image {angle_deg:.0f} degrees{shift} from where the sweep has it on the "
                f"{calibration.sensor} sensor, and is used: is it of this mounting?"
            )
    return apply_calibrations(sweep, paths)[0]
