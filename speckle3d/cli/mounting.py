"""Calibrations that a command puts on a sweep's sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from speckle3d.cli.common import note

if TYPE_CHECKING:
    from speckle3d.core.calibration import Calibration
    from speckle3d.core.sweep import ImageGrid, Sweep

CalibrationFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--calibration", help="Calibration to use for its sensor in place of the file's; may be repeated."
    ),
]

NOTED_SIZE = 0.01
"""Relative difference of pixel sizes from which it is told: 0.4 mm over an image of 40 mm."""

NOTED_OFFSET_S = 0.001

NOTED_DEG, NOTED_MM = 5.0, 10.0
"""Difference of mountings from which it is told: no calibration of the same mounting is so far off."""


def mount(sweep: Sweep, paths: Sequence[Path]) -> Sweep:
    """Put calibration files on a sweep's sensors, and say on stderr where they contradict the sweep."""
    from speckle3d.io.calibrations import apply_calibrations, read_calibration

    mounted, _ = apply_calibrations(sweep, paths)
    for path in paths:
        _note_differences(sweep, path, read_calibration(path))
    return mounted


def fitted_pixels(paths: Sequence[Path]) -> dict[str, float]:
    """Pixel size of the first calibration that knows one, as import settings of B-mode; else nothing."""
    from speckle3d.io.calibrations import read_calibration

    for path in paths:
        pixel_mm = read_calibration(path).pixel_mm
        if pixel_mm is not None:
            return {"column_pitch_mm": float(pixel_mm[0]), "row_spacing_mm": float(pixel_mm[1])}
    return {}


def resize(sweep: Sweep, sizes: dict[str, float]) -> Sweep:
    """Put pixel sizes, by their names in the import settings, on a sweep of B-mode images."""
    from speckle3d.core.sweep import BModeSettings

    if not isinstance(sweep.signal, BModeSettings):
        return sweep
    grid = sweep.grid
    column_mm = sizes.get("column_pitch_mm", grid.vector_pitch_mm)
    row_mm = sizes.get("row_spacing_mm", grid.sample_spacing_mm)
    # A calibration counts rows from the probe's face, also those above the first that is stored.
    first_mm = grid.first_sample_depth_mm * row_mm / grid.sample_spacing_mm
    resized = replace(
        grid, vector_pitch_mm=column_mm, sample_spacing_mm=row_mm, first_sample_depth_mm=first_mm
    )
    return replace(sweep, grid=resized)


def _note_differences(sweep: Sweep, path: Path, calibration: Calibration) -> None:
    from speckle3d.core.calibration import pixel_difference

    grid, pixel_mm = _image_grid(sweep), calibration.pixel_mm
    if pixel_mm is not None and pixel_difference(grid, calibration) > NOTED_SIZE:
        note(
            f"{path}: found pixels of {pixel_mm[0]:.4g} x {pixel_mm[1]:.4g} mm, "
            f"those of the sweep's images are {grid.vector_pitch_mm:.4g} x {grid.sample_spacing_mm:.4g} mm"
            " and stay so"
        )
    sensor = sweep.tracker if calibration.sensor == "tracker" else sweep.orientation
    held_s, found_s = (0.0 if sensor is None else sensor.time_offset_s), calibration.time_offset_s
    if held_s and found_s is not None and abs(found_s - held_s) > NOTED_OFFSET_S:
        note(f"{path}: time offset {found_s:+.4f} s is used, not the sweep's {held_s:+.4f} s")
    _note_mounting(sweep, path, calibration)


def _note_mounting(sweep: Sweep, path: Path, calibration: Calibration) -> None:
    """Say where a calibration puts the image quite elsewhere than the sweep does."""
    from speckle3d.core.calibration import mounting_difference

    turned_deg, moved_mm = mounting_difference(sweep, calibration)
    if turned_deg > NOTED_DEG or moved_mm > NOTED_MM:
        moved = f" and {moved_mm:.0f} mm" if calibration.sensor == "tracker" else ""
        note(
            f"{path}: puts the image {turned_deg:.0f} degrees{moved} from where the sweep has it on the "
            f"{calibration.sensor} sensor, and is used: is it of this mounting?"
        )


def _image_grid(sweep: Sweep) -> ImageGrid:
    """Grid of the images, in which a calibration counts pixels: from RF they are made with fewer samples."""
    from speckle3d.matching.intensity import IntensityExtractor

    return IntensityExtractor.for_sweep(sweep).grid
