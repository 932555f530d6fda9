"""How IGSIO, on which PLUS and Slicer stand, makes a volume of tracked images: an oracle for tests.

Written from what its source does, `vtkIGSIOPasteSliceIntoVolume` with ``Optimization="FULL"``.
What it does otherwise than the definition of a mean:

- Places are whole multiples of 2^-14 voxel, and so are the steps between pixels: over a row of 820 pixels
  the place is off by up to 0.025 voxel.
- Nearest: a voxel's mean is kept in whole grey levels and cut to one after every pixel, so it falls.
- Linear: it is rounded after every pixel, so one that differs from it by less than half the pixels so far
  does not count at all. The weight is kept in steps of 1/256 and stays at 256 from there on.
- Nearest: from the 256th pixel on, the mean moves 1/256 of the way to each, cut to whole levels.
"""

from dataclasses import dataclass

import numpy as np

ONE = 2**14
"""A voxel's side, and the whole of a pixel, in its fixed-point numbers."""

ONE_PIXEL, MOST, LAST = 256, 65535, 65535 - 256
"""Weight of a pixel, the most that is kept, and the most at which one more is added."""


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


def paste(images, voxel_from_pixel, shape, clip, linear=False, mask=None):
    """Volume and weights, both indexed [i, j, k], of images (frame, row, column) put in one after another.

    Parameters
    ----------
    voxel_from_pixel : ndarray, shape (n, 3, 4)
        Affine maps from (column, row, 0, 1) to voxel indices.
    mask : ndarray of bool, shape (height, width), optional
        Pixels that count, in place of the clip's.
    """
    volume, weight = np.zeros(shape, int), np.zeros(shape, int)
    put = _linear if linear else _nearest
    maps = np.rint(np.asarray(voxel_from_pixel) * ONE).astype(int)[:, :, [0, 1, 3]]
    rows, columns = np.nonzero(clip.mask(*images.shape[:0:-1]) if mask is None else mask)  # row by row
    for image, axes in zip(images, maps, strict=True):
        for row, column in zip(rows, columns, strict=True):
            put(volume, weight, axes @ [column, row, 1], int(image[row, column]))
    return volume.astype(np.uint8), weight.astype(np.uint16)


def _nearest(volume, weight, place, level):
    at = tuple((place + ONE // 2) // ONE)
    if any(not 0 <= a < n for a, n in zip(at, volume.shape, strict=True)):
        return
    held, so_far = int(volume[at]), int(weight[at])
    if so_far <= LAST:
        volume[at] = (level * ONE_PIXEL + held * so_far) // (so_far + ONE_PIXEL)
        weight[at] = so_far + ONE_PIXEL
    else:
        volume[at] = int(level / 256 + held * 255 / 256)


def _linear(volume, weight, place, level):
    first, ahead = place // ONE, place % ONE
    if (first < 0).any() or (first + (ahead > 0) >= volume.shape).any():
        return
    for corner in np.ndindex(2, 2, 2):
        share = np.where(corner, ahead, ONE - ahead)
        f = int(share[0] * ((share[1] * share[2] + ONE // 2) // ONE) + ONE // 2) // ONE
        if f == 0:
            continue
        at = tuple(first + corner)
        held, so_far = int(volume[at]), int(weight[at])
        r = so_far * ONE // 256
        volume[at] = (round((f * level + r * held) / (f + r) * ONE) + ONE // 2) // ONE
        weight[at] = min(((f + r) * 256 + ONE // 2) // ONE, MOST)
