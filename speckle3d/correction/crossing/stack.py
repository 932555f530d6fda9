"""Reduced images of a sweep: small enough to keep all, fine enough to find places again."""

import numpy as np

from speckle3d.core.arrays import Float16Array, Float32Array
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.grid import ImageGrid, ScanConversion, box_grid

PIXEL_MM = 0.35
"""About the finest blur at which sweeps are compared: finer pixels show only speckle that the other sweep's
beam, thick in another direction, does not show alike."""


class ImageStack:
    """Log-compressed images of a sweep, pooled to pixels of about a third of a millimetre.

    An image sink of `speckle3d.track`: pass `keep` as ``images``.

    Those of a fan are scan converted, and NaN outside it.

    Parameters
    ----------
    grid : ImageGrid
        Of the speckle intensity images that `keep` gets. Pooled pixels are never finer than its vectors.

    Attributes
    ----------
    grid : ImageGrid
        Of the pooled images, in the frame of the whole ones.
    """

    def __init__(self, grid: ImageGrid) -> None:
        self._convert = None
        if grid.fan is not None:
            self._convert = ScanConversion(grid, box_grid(grid, PIXEL_MM))
            grid = self._convert.grid
        across = max(1, min(grid.vectors, round(PIXEL_MM / grid.vector_pitch_mm)))
        deep = max(1, min(grid.samples, round(PIXEL_MM / grid.sample_spacing_mm)))
        self._pool = across, deep
        self.grid = ImageGrid(
            grid.vectors // across,
            grid.samples // deep,
            grid.vector_pitch_mm * across,
            grid.sample_spacing_mm * deep,
            grid.first_sample_depth_mm + (deep - 1) / 2 * grid.sample_spacing_mm,
            first_vector_mm=grid.first_vector_mm + (across - 1) / 2 * grid.vector_pitch_mm,
        )
        self._images: dict[int, Float16Array] = {}

    def keep(self, index: int, intensity: Float32Array) -> None:
        """Keep one frame of speckle intensity, shape (vector, sample)."""
        if self._convert is not None:
            intensity = self._convert(intensity)
        across, deep = self._pool
        wide, high = self.grid.vectors, self.grid.samples
        part = intensity[: wide * across, : high * deep]
        means = part.reshape(wide, across, high, deep).mean(axis=(1, 3), dtype=np.float32)
        self._images[index] = (10 * np.log10(np.maximum(means, 1e-12))).astype(np.float16)

    def take(self, first: int, images: Float16Array) -> None:
        """Keep images of the frames from `first` on that were pooled elsewhere."""
        self._images.update(enumerate(images, start=first))

    def images(self, frames: int) -> Float32Array:
        """Images of the first frames, shape (frames, vector, sample), dB.

        Raises
        ------
        InsufficientDataError
            If one of the frames was not kept.
        """
        missing = [index for index in range(frames) if index not in self._images]
        if missing:
            raise InsufficientDataError(
                f"expected an image of each of {frames} frames, got none of frame {missing[0]}: track the "
                "sweep with the stack as its image sink"
            )
        return np.stack([self._images[index] for index in range(frames)]).astype(np.float32)
