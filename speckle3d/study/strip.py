"""A narrow strip of every frame of a sweep, for a picture along the sweep."""

from __future__ import annotations

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import Float16Array, Float32Array
from speckle3d.core.sweep import ImageGrid, Sweep
from speckle3d.matching.intensity import IntensityExtractor

STRIP_MM = 2.4
STRIP_SPACING_MM = 0.1


class Strip:
    """A few vectors about the middle of every frame, pooled in depth: enough for a reslice, and small."""

    def __init__(self, sweep: Sweep, config: Config) -> None:
        grid = IntensityExtractor.for_sweep(sweep, config.intensity).grid
        width = min(grid.vectors, 2 * int(STRIP_MM / 2 / grid.vector_pitch_mm) + 1)
        self._first = (grid.vectors - width) // 2
        self._pool = max(1, round(STRIP_SPACING_MM / grid.sample_spacing_mm))
        self.grid = ImageGrid(
            width,
            grid.samples // self._pool,
            grid.vector_pitch_mm,
            grid.sample_spacing_mm * self._pool,
            grid.first_sample_depth_mm + (self._pool - 1) / 2 * grid.sample_spacing_mm,
        )
        self.left_mm = self._first * grid.vector_pitch_mm
        self._images: dict[int, Float16Array] = {}

    def keep(self, index: int, intensity: Float32Array) -> None:
        """Keep the strip of a frame."""
        part = intensity[self._first : self._first + self.grid.vectors, : self.grid.samples * self._pool]
        pooled = part.reshape(self.grid.vectors, self.grid.samples, self._pool).mean(axis=2)
        decibel = 10 * np.log10(np.maximum(pooled, 1e-12))
        self._images[index] = decibel.astype(np.float16)

    def kept(self, first: int, stop: int) -> Float16Array:
        """Strips of some frames as they are kept, shape (frame, vector, sample), dB."""
        return np.stack([self._images[index] for index in range(first, stop)])

    def take(self, first: int, images: Float16Array) -> None:
        """Keep strips of the frames from `first` on that were made elsewhere."""
        self._images.update(enumerate(images, start=first))

    def __getitem__(self, index: int) -> Float32Array:
        return self._images[index].astype(np.float32)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (frame, vector, sample)."""
        return len(self._images), self.grid.vectors, self.grid.samples
