"""Repeated calibrations, compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from speckle3d.cli.common import Json, calibrate, emit, note


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
        emit(json.dumps(table, indent=2))
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
