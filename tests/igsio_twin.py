"""Which pixels IGSIO, on which PLUS and Slicer stand, takes of tracked images, and the grid around them.

Written from what its source does, `vtkIGSIOPasteSliceIntoVolume`.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Clip:
    """Part of the images that counts, in pixels: first and last column and row; a fan, if any."""

    columns: tuple[int, int]
    rows: tuple[int, int]
    fan: tuple[float, float, float, float, float, float] | None = None
    """Column and row of its origin, least and greatest radius, least and greatest angle in degrees."""

    def spans(self, width, height):
        """First and last column of both pieces of every row, shape (height, 2, 2); none if last < first."""
        spans = np.tile([0, -1], (height, 2, 1))
        left, right = max(self.columns[0], 0), min(self.columns[1], width - 1)
        for row in range(max(self.rows[0], 0), min(self.rows[1], height - 1) + 1):
            pieces = [(left, right)] if self.fan is None else self._of_fan(row, left, right)
            for i, piece in enumerate(pieces):
                spans[row, i] = piece
        return spans

    def mask(self, width, height):
        """Whether each pixel counts, shape (height, width)."""
        columns, spans = np.arange(width), self.spans(width, height)
        inside = (spans[..., 0, None] <= columns) & (columns <= spans[..., 1, None])
        return inside.any(axis=1)

    def _of_fan(self, row, left, right):
        x, y, inner, outer, low, high = self.fan
        down = row - y
        lean = sorted(np.tan(np.deg2rad([low, high])))
        left = max(left, _ceil(lean[0] * down + x + 1))
        right = min(right, _floor(lean[1] * down + x - 1))
        if outer**2 < down**2:
            return []
        half = np.sqrt(outer**2 - down**2)
        left, right = max(left, _ceil(x - half + 1)), min(right, _floor(x + half - 1))
        if left > right or inner**2 <= down**2:
            return [(left, right)]
        hole = np.sqrt(inner**2 - down**2)
        first, last = _ceil(x - hole + 1), _floor(x + hole - 1)
        if first < left:
            return [(max(left, last + 1), right)]
        if last > right:
            return [(left, min(right, first - 1))]
        return [(left, first - 1), (last + 1, right)]


def _floor(value):
    return int(np.floor(value + 2.0**-17))


def _ceil(value):
    return -_floor(-value)


def grid_of(reference_from_image, clip, width, height, spacing_mm):
    """Origin and shape of the volume around all images, as PLUS chose it before it snapped to the spacing."""
    x = max(clip.columns[0], 0), min(clip.columns[1], width - 1)
    y = max(clip.rows[0], 0), min(clip.rows[1], height - 1)
    corners = np.array([[a, b, 0.0, 1.0] for a in x for b in y])
    places = np.einsum("nij,cj->nci", reference_from_image, corners)[..., :3].reshape(-1, 3)
    low, high = places.min(axis=0), places.max(axis=0)
    return low, tuple((np.rint((high - low) / spacing_mm).astype(int) + 1).tolist())
