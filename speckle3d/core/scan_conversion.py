"""Scan conversion: images along the vectors of a fan to pictures of rows and columns."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.grid import ImageGrid

_PIXELS_PER_PITCH = 4
"""Of the picture in the distance of neighbouring vectors at the middle depth: linear interpolation between
vectors then shows nothing of the pixels."""


def box_grid(fan: ImageGrid, pixel_mm: float) -> ImageGrid:
    """Grid of square pixels over the smallest box around a fan."""
    left, top = fan.extent_mm[0].tolist()
    columns, rows = (int(count) + 1 for count in np.ceil(np.ptp(fan.extent_mm, axis=0) / pixel_mm - 1e-6))
    return ImageGrid(columns, rows, pixel_mm, pixel_mm, top, first_vector_mm=left)


class ScanConversion:
    """Draws images of a fan on a rectangle about it.

    Parameters
    ----------
    fan : ImageGrid
        Of the images.
    grid : ImageGrid, optional
        Of the pictures; by default the box of the fan in square pixels, a quarter of the pitch of vectors or
        a sample wide.

    Attributes
    ----------
    grid : ImageGrid
        In the same image frame P.
    """

    def __init__(self, fan: ImageGrid, grid: ImageGrid | None = None) -> None:
        self._fan = fan
        self.grid = grid or box_grid(fan, max(fan.vector_pitch_mm / _PIXELS_PER_PITCH, fan.sample_spacing_mm))

    def __call__(self, image: npt.NDArray[Any]) -> Float32Array:
        """Picture of an image, shape (column, row), by linear interpolation; NaN outside the fan.

        Parameters
        ----------
        image : ndarray, shape (vector, sample)
        """
        levels = np.asarray(image, dtype=np.float32)
        return map_coordinates(levels, self._sample, np.float32, order=1, cval=np.nan, prefilter=False)

    @cached_property
    def _sample(self) -> FloatArray:
        """Vector and sample of each pixel, shape (2, column, row)."""
        column, row = np.arange(self.grid.vectors)[:, None], np.arange(self.grid.samples)
        # Places on the fan's edge are inside it whatever rounding does.
        return np.moveaxis(self._fan.sample_at(self.grid.mm(column, row)).round(6), -1, 0)
