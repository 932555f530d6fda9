"""Scan conversion: images along the vectors of a fan to pictures of rows and columns."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.sweep import ImageGrid

_PIXELS_PER_PITCH = 4
"""Of the picture in the distance of neighbouring vectors at the middle depth: linear interpolation between
vectors then shows nothing of the pixels."""


class ScanConversion:
    """Draws images of a fan on a rectangle about it.

    Parameters
    ----------
    fan : ImageGrid
        Of the images.
    grid : ImageGrid, optional
        Of the pictures; by default with square pixels, a quarter of the vectors' pitch or a sample wide.
    left_mm : float
        Where the first column lies in the image frame P.

    Attributes
    ----------
    grid : ImageGrid
        In the same image frame P, `left_mm` to the side.
    """

    def __init__(self, fan: ImageGrid, grid: ImageGrid | None = None, left_mm: float = 0.0) -> None:
        self._fan, self._left_mm = fan, left_mm
        if grid is None:
            side = max(fan.vector_pitch_mm / _PIXELS_PER_PITCH, fan.sample_spacing_mm)
            low, high = fan.corners_mm[0, :2], fan.corners_mm[2, :2]
            columns, rows = (int(count) + 1 for count in np.ceil((high - low) / side - 1e-6))
            grid = ImageGrid(columns, rows, side, side, float(low[1]))
        self.grid = grid

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
        place = self.grid.mm(column, row) + np.array([self._left_mm, 0.0])
        sample = np.moveaxis(self._fan.sample_at(place), -1, 0)
        # Places on the fan's edge are inside it whatever rounding does.
        last = np.array([self._fan.vectors - 1, self._fan.samples - 1])[:, None, None]
        near = (sample > -1e-6) & (sample < last + 1e-6)
        return np.where(near, np.clip(sample, 0, last), sample)
