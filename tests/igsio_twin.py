"""Which pixels IGSIO, on which PLUS and Slicer stand, takes of tracked images, and the grid around them.

Written from what its source does, `vtkIGSIOPasteSliceIntoVolume`.
"""

from dataclasses import dataclass

import numpy as np

SIDE = 1.0 - 2.0**-17
"""How far a fan's sides are moved in, pixels, but for rounding."""


@dataclass(frozen=True)
class Clip:
    """Part of the images that counts, in pixels: first and last column and row; a fan, if any."""

    columns: tuple[int, int]
    rows: tuple[int, int]
    fan: tuple[float, float, float, float, float, float] | None = None
    """Column and row of its origin, least and greatest radius, least and greatest angle in degrees."""

    def mask(self, width, height):
        """Whether each pixel counts, shape (height, width); the sides of the fan are a pixel further in."""
        row, column = np.mgrid[:height, :width]
        inside = (self.columns[0] <= column) & (column <= self.columns[1])
        inside &= (self.rows[0] <= row) & (row <= self.rows[1])
        if self.fan is None:
            return inside
        x, y, inner, outer, low, high = self.fan
        down, over = row - y, column - x
        left, right = np.sort(np.tan(np.deg2rad([low, high])))[:, None, None] * down
        with np.errstate(invalid="ignore"):
            rim, hole = (np.abs(over) <= np.sqrt(r**2 - down**2) - SIDE for r in (outer, inner))
        return inside & (over >= left + SIDE) & (over <= right - SIDE) & rim & ~hole


def grid_of(reference_from_image, clip, width, height, spacing_mm):
    """Origin and shape of the volume around all images, as PLUS chose it before it snapped to the spacing."""
    x = max(clip.columns[0], 0), min(clip.columns[1], width - 1)
    y = max(clip.rows[0], 0), min(clip.rows[1], height - 1)
    corners = np.array([[a, b, 0.0, 1.0] for a in x for b in y])
    places = np.einsum("nij,cj->nci", reference_from_image, corners)[..., :3].reshape(-1, 3)
    low, high = places.min(axis=0), places.max(axis=0)
    return low, tuple((np.rint((high - low) / spacing_mm).astype(int) + 1).tolist())
