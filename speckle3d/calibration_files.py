"""Calibration files put on sweeps: their sensors' mountings and delays, and the size of pixels."""

from collections.abc import Sequence
from dataclasses import replace

from speckle3d.core.calibration import calibrated
from speckle3d.core.errors import MismatchError, naming
from speckle3d.core.files import PathLike
from speckle3d.core.reconstruction import CalibrationFile
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.core.text import written_path
from speckle3d.io.family.calibrations import read_calibration
from speckle3d.io.hdf5 import sha256_of


def apply_calibrations(sweep: Sweep, paths: Sequence[PathLike]) -> tuple[Sweep, tuple[CalibrationFile, ...]]:
    """Put calibration files on a sweep's sensors, one to a sensor, and tell which they were.

    Raises
    ------
    FileError, InvalidInputError
        Naming the file and what in it is wrong.
    MismatchError
        If two are for one sensor, or the sweep has no such sensor.
    """
    files: dict[str, CalibrationFile] = {}
    for path in paths:
        calibration = read_calibration(path)
        sensor = calibration.sensor
        if sensor in files:
            raise MismatchError(
                f"{path}: expected one calibration for a sensor, got {files[sensor].path} too"
            )
        with naming(str(path)):
            sweep = calibrated(sweep, calibration)
        files[sensor] = CalibrationFile(sensor, written_path(path), sha256_of(path))
    return sweep, tuple(files.values())


def fitted_pixels(paths: Sequence[PathLike]) -> dict[str, float]:
    """Return the pixel size of the first calibration that has one, as import settings of B-mode images."""
    for path in paths:
        if (pixel_mm := read_calibration(path).pixel_mm) is not None:
            return dict(zip(("column_pitch_mm", "row_spacing_mm"), pixel_mm.tolist(), strict=True))
    return {}


def resized(sweep: Sweep, sizes: dict[str, float]) -> Sweep:
    """Replace the pixel size of a sweep of B-mode images; names are those of the import settings."""
    if not isinstance(sweep.signal, BModeSettings):
        return sweep
    grid = sweep.grid
    pitch_mm = sizes.get("column_pitch_mm", grid.vector_pitch_mm)
    row_mm = sizes.get("row_spacing_mm", grid.sample_spacing_mm)
    # Rows count from the probe's face, including those above the first stored row.
    first_mm = grid.first_sample_depth_mm * row_mm / grid.sample_spacing_mm
    grid = replace(grid, vector_pitch_mm=pitch_mm, sample_spacing_mm=row_mm, first_sample_depth_mm=first_mm)
    return replace(sweep, grid=grid)
