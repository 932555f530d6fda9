"""Grey images of a reconstructed sweep, made as they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from speckle3d.config import config_from_toml
from speckle3d.core.arrays import Float32Array
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.io.hdf5 import sha256_of
from speckle3d.io.load import load_sweep
from speckle3d.io.reconstructions import read_reconstruction
from speckle3d.matching.intensity import IntensityExtractor, IntensitySettings

_GLANCES = 24
"""Frames looked at for the brightest echo; one between them may still be cut off by a few decibels."""


class GreyImages:
    """Log-compressed images of a sweep, 0 to 255, by frame number.

    Parameters
    ----------
    clipped : bool
        Let the brightest echoes saturate, as on a screen.

    Attributes
    ----------
    grid : ImageGrid
        Where their samples lie.
    """

    def __init__(
        self,
        sweep: Sweep,
        dynamic_range_db: float,
        progress: Callable[[int, int], None] | None = None,
        settings: IntensitySettings | None = None,
        clipped: bool = True,
    ) -> None:
        if not (np.isfinite(dynamic_range_db) and dynamic_range_db > 0):
            raise InvalidInputError(f"dynamic_range_db: expected a value above zero, got {dynamic_range_db}")
        self._extractor = IntensityExtractor.for_sweep(sweep, settings)
        self._sweep, self._range_db, self._progress = sweep, dynamic_range_db, progress
        self.grid: ImageGrid = self._extractor.grid
        # One level for the whole sweep. For looking, the 99.9th percentile, so that one specular echo does
        # not darken it; for measuring an echo's place, the brightest, so that none is cut off.
        if clipped:
            self._brightest = float(np.percentile(self._decibel(len(sweep) // 2), 99.9))
        else:
            some = np.unique(np.linspace(0, len(sweep) - 1, _GLANCES).astype(int))
            self._brightest = max(float(self._decibel(int(i)).max()) for i in some)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""
        return len(self._sweep), self.grid.vectors, self.grid.samples

    @property
    def dtype(self) -> np.dtype[np.float32]:
        """Type of the grey levels."""
        return np.dtype(np.float32)

    def __getitem__(self, index: int) -> Float32Array:
        if self._progress:
            self._progress(index + 1, len(self._sweep))
        level = 1 + (self._decibel(index) - self._brightest) / self._range_db
        return np.asarray(255 * np.clip(level, 0, 1), dtype=np.float32)

    def _decibel(self, index: int) -> Float32Array:
        intensity = self._extractor.intensity(self._sweep.frames[index])
        return np.asarray(10 * np.log10(np.maximum(intensity, np.float32(1e-12))))


def grey_images(
    sweep: Sweep,
    dynamic_range_db: float = 60.0,
    progress: Callable[[int, int], None] | None = None,
    reconstruction: Reconstruction | None = None,
) -> GreyImages:
    """Make a sweep's images for compounding and reslicing, as its reconstruction was configured."""
    settings = None
    if reconstruction is not None and reconstruction.config_toml:
        settings = config_from_toml(reconstruction.config_toml).intensity
    return GreyImages(sweep, dynamic_range_db, progress, settings)


def open_reconstruction(path: Path, sweep_file: Path | None = None) -> tuple[Reconstruction, Sweep]:
    """Open a reconstruction and the sweep it was made from.

    Raises
    ------
    MismatchError
        If the sweep's bytes are not those that were reconstructed.
    """
    reconstruction = read_reconstruction(path, with_pairs=False)
    stored = Path(reconstruction.provenance.input_path)
    # As given, or from where the reconstruction lies.
    source = sweep_file or (stored if stored.is_file() else path.parent / stored)
    if not source.is_file():
        raise InvalidInputError(f"{path}: expected its sweep at {source}, got none; say where it is: --sweep")
    if sha256_of(source) != reconstruction.provenance.input_sha256:
        raise MismatchError(f"{source}: expected the sweep that {path} was made from, got another (SHA-256)")
    return reconstruction, load_sweep(source)
