"""Grey images of a sweep to look at, and the sweep that a reconstruction was made from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from speckle3d.calibration_files import apply_calibrations
from speckle3d.config import stored_config
from speckle3d.core.arrays import AnyArray, Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.grid import ImageGrid, ScanConversion
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.imaging.voxels.settings import Levels
from speckle3d.io.family.reconstructions import read_reconstruction
from speckle3d.io.load import load_sweep, recording_sha256
from speckle3d.matching.intensity import IntensityExtractor, IntensitySettings

_GLANCES = 24
"""Frames looked at for the brightest echo; one between them may still be cut off by a few decibels."""


class GreyImages:
    """Grey images of a sweep by frame number, made one at a time as they are asked for.

    Those of a curved or phased array are scan converted, and NaN outside the fan.

    Parameters
    ----------
    sweep : Sweep
    dynamic_range_db : float
        Of the log-compressed levels 0 to 255.
    settings : IntensitySettings, optional
    clipped : bool
        Let the brightest echoes saturate, as on a screen.
    levels : {"log", "linear", "stored"}
        Log-compressed to 0-255, linear echo amplitude, or B-mode as it is stored.
    outside : float
        Level of what is outside a fan.

    Attributes
    ----------
    grid : ImageGrid
        Where their samples lie.
    meaning : str
        What the grey levels are, in words.
    dtype : numpy.dtype
        Of the grey levels.

    Raises
    ------
    InvalidInputError
        If `dynamic_range_db` is not above zero, or echoes are asked for as stored.
    """

    any_thread = True

    def __init__(
        self,
        sweep: Sweep,
        dynamic_range_db: float = 60.0,
        settings: IntensitySettings | None = None,
        clipped: bool = True,
        levels: Levels = "log",
        outside: float = np.nan,
    ) -> None:
        if not (np.isfinite(dynamic_range_db) and dynamic_range_db > 0):
            raise InvalidInputError(f"dynamic_range_db: expected a value above zero, got {dynamic_range_db}")
        bmode = sweep.signal if isinstance(sweep.signal, BModeSettings) else None
        self._sweep, self._levels, self._outside = sweep, levels, outside
        self._extractor = IntensityExtractor(sweep.signal, sweep.grid, settings)
        source = sweep.grid if levels == "stored" else self._extractor.grid
        self._convert = ScanConversion(source) if source.fan is not None else None
        self.grid: ImageGrid = self._convert.grid if self._convert else source
        self.dtype: np.dtype[Any] = np.dtype(np.float32)
        self.meaning = f"log-compressed, 0 to 255 over {dynamic_range_db:g} dB"
        if levels == "stored":
            if bmode is None:
                raise InvalidInputError(
                    f"{sweep.name}: expected B-mode for levels as stored, got RF or I/Q: take log or linear"
                )
            if self._convert is None:
                self.dtype = np.dtype(sweep.frames.dtype)
            self.meaning = f"B-mode as stored, 0 to {bmode.full_scale:g}"
        elif levels == "linear":
            self.meaning = "echo amplitude, linear, " + (
                "in the units of the samples"
                if bmode is None
                else f"of B-mode over {bmode.dynamic_range_db:g} dB; 1 is full scale"
            )
        else:
            self._range_db = dynamic_range_db
            # One level for the whole sweep. For looking, the 99.9th percentile, so that one specular echo
            # does not darken it; for measuring an echo's place, the brightest, so that none is cut off.
            frames = [len(sweep) // 2] if clipped else np.linspace(0, len(sweep) - 1, _GLANCES).astype(int)
            images = [_decibel(self._extractor.echo(sweep.frames[int(i)]).intensity) for i in frames]
            self._brightest = max(float(np.percentile(image, 99.9 if clipped else 100)) for image in images)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""
        return len(self._sweep), self.grid.vectors, self.grid.samples

    def __getitem__(self, index: int) -> AnyArray:
        levels = self._levels_of(self._sweep.frames[index])
        return levels if self._convert is None else np.nan_to_num(self._convert(levels), nan=self._outside)

    def _levels_of(self, frame: AnyArray) -> AnyArray:
        if self._levels == "stored":
            return frame
        intensity = self._extractor.echo(frame).intensity
        if self._levels == "linear":
            return np.asarray(np.sqrt(intensity), dtype=np.float32)
        level = 1 + (_decibel(intensity) - self._brightest) / self._range_db
        return np.asarray(255 * np.clip(level, 0, 1), dtype=np.float32)


def _decibel(intensity: Float32Array) -> Float32Array:
    return 10 * np.log10(np.maximum(intensity, np.float32(1e-12)))


def grey_images(
    sweep: Sweep,
    dynamic_range_db: float = 60.0,
    reconstruction: Reconstruction | None = None,
    levels: Levels = "log",
) -> GreyImages:
    """Make a sweep's grey images for compounding and reslicing, one at a time as they are asked for.

    Parameters
    ----------
    sweep : Sweep
    dynamic_range_db : float
        Range of the log-compressed grey levels 0 to 255.
    reconstruction : Reconstruction, optional
        To make the images as its configuration says.
    levels : {"log", "linear", "stored"}
        Log-compressed to 0-255, linear echo amplitude, or B-mode as it is stored.

    Returns
    -------
    GreyImages
        Indexed by frame: float32, or the type that is stored, shape (vector, sample).

    Raises
    ------
    InvalidInputError
        If `dynamic_range_db` is not above zero, or echoes are asked for as stored.

    Examples
    --------
    >>> import speckle3d as s3
    >>> sweep = s3.load_sweep("data/phantom.h5")
    >>> images = s3.grey_images(sweep, dynamic_range_db=50.0)
    >>> images.shape == (len(sweep), images.grid.vectors, images.grid.samples)
    True
    >>> bool(0 <= images[0].min() and images[0].max() <= 255)
    True
    """
    settings = None
    if reconstruction is not None and reconstruction.config_toml:
        settings = stored_config(reconstruction.config_toml).intensity
    return GreyImages(sweep, dynamic_range_db, settings, levels=levels)


def open_reconstruction(path: Path, sweep_file: Path | None = None) -> tuple[Reconstruction, Sweep]:
    """Open a reconstruction and the sweep it was made from, as `sweep_of`."""
    reconstruction = read_reconstruction(path, with_pairs=False)
    source = Path(reconstruction.provenance.input_path)
    # As the file says, then from the reconstruction's folder and from the one above.
    places = (source, path.parent / source, path.absolute().parent.parent / source)
    source = sweep_file or next((place for place in places if place.exists()), source)
    return reconstruction, sweep_of(reconstruction, source)


def sweep_of(reconstruction: Reconstruction, source: Path) -> Sweep:
    """Open the sweep that a reconstruction was made from, with the calibrations that it was made with.

    Those that are no longer there are left out.

    Raises
    ------
    InvalidInputError
        If there is no such file.
    MismatchError
        If the sweep's bytes are not those that were reconstructed.
    """
    provenance = reconstruction.provenance
    if not source.exists():
        raise InvalidInputError(
            f"{source}: expected the sweep that was reconstructed, got none: give --sweep"
        )
    if recording_sha256(source) != provenance.input_sha256:
        raise MismatchError(f"{source}: expected the sweep that was reconstructed, got another (SHA-256)")
    calibrations = [file.path for file in provenance.calibrations if Path(file.path).exists()]
    return apply_calibrations(part_at(load_sweep(source), reconstruction.frame_time_s), calibrations)[0]


def part_at(sweep: Sweep, time_s: FloatArray) -> Sweep:
    """The part of a recording whose frames have these times: all of it, or what was reconstructed of it.

    Raises
    ------
    MismatchError
        If no frames in a row have these times.
    """
    first = int(np.searchsorted(sweep.frame_time_s, time_s[0]))
    times = sweep.frame_time_s[first : first + len(time_s)]
    if not np.array_equal(times, time_s):
        raise MismatchError(f"{sweep.name}: expected frames at the times that were reconstructed, got others")
    return sweep if len(times) == len(sweep) else sweep.part(first, first + len(times))
