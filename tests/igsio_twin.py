"""How IGSIO, on which PLUS and Slicer stand, makes a volume of tracked images: an oracle for tests.

Written from what its sources do, `vtkIGSIOPasteSliceIntoVolume` and `vtkIGSIOFillHolesInVolume`, with
``Optimization="FULL"``. What it does otherwise than the definition of a mean:

- Places are whole multiples of 2^-14 voxel, and so are the steps between pixels: over a row of 820 pixels
  the place is off by up to 0.025 voxel.
- Nearest: a voxel's mean is kept in whole grey levels and cut to one after every pixel, so it falls.
- Linear: it is rounded after every pixel, so one that differs from it by less than half the pixels so far
  does not count at all. The weight is kept in steps of 1/256 and stays at 256 from there on.
- Nearest: from the 256th pixel on, the mean moves 1/256 of the way to each, cut to whole levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

POINT = 14
"""Binary places of its fixed-point numbers."""

ONE_PIXEL, MOST, LAST = 256, 65535, 65535 - 256
"""Weight of a pixel, the most that is kept, and the most at which one more is added."""

STICKS = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1],
     [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, -1, 0], [1, 0, -1], [0, 1, -1],
     [1, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1]]
)  # fmt: skip
"""Directions in which holes are looked across, along i, j and k."""


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


def paste(images, voxel_from_pixel, shape, clip, linear=False, rule="mean", point=POINT):
    """Volume and weights, both indexed [i, j, k], of images (frame, row, column) put in one after another.

    Parameters
    ----------
    voxel_from_pixel : ndarray, shape (n, 3, 4)
        Affine maps from (column, row, 0, 1) to voxel indices.
    point : int
        Binary places of places and shares; with 24, a place is off by 0.00002 voxel over 820 pixels.
    """
    height, width = images.shape[1:]
    volume, weight = np.zeros(shape, np.uint8), np.zeros(shape, np.uint16)
    maps = np.rint(np.asarray(voxel_from_pixel) * 2.0**point).astype(np.int64)[:, :, [0, 1, 3]]
    spans = clip.spans(width, height)
    number = {"mean": 0, "maximum": 1, "latest": 2}[rule]
    put = _linear if linear else _nearest
    if images.size < 10_000:  # sooner done than compiled
        put = put.py_func
    for image, axes in zip(images, maps, strict=True):
        put(np.ascontiguousarray(image), axes, spans, volume, weight, number, point)
    return volume, weight


@njit(cache=True, fastmath=False)
def _nearest(image, axes, spans, volume, weight, rule, point):
    n_i, n_j, n_k = volume.shape
    half = 1 << (point - 1)
    for row in range(image.shape[0]):
        for piece in range(2):
            for column in range(spans[row, piece, 0], spans[row, piece, 1] + 1):
                place = axes[:, 2] + row * axes[:, 1] + column * axes[:, 0]
                i, j, k = (place + half) >> point
                if not (0 <= i < n_i and 0 <= j < n_j and 0 <= k < n_k):
                    continue
                level, so_far, held = int(image[row, column]), int(weight[i, j, k]), int(volume[i, j, k])
                if rule == 1:
                    volume[i, j, k] = max(level, held)
                    weight[i, j, k] = ONE_PIXEL
                elif rule == 2:
                    volume[i, j, k] = level
                    weight[i, j, k] = ONE_PIXEL
                elif so_far <= LAST:
                    volume[i, j, k] = (level * ONE_PIXEL + held * so_far) // (so_far + ONE_PIXEL)
                    weight[i, j, k] = so_far + ONE_PIXEL
                else:
                    volume[i, j, k] = int(level / 256 + held * 255 / 256)


@njit(cache=True, fastmath=False)
def _linear(image, axes, spans, volume, weight, rule, point):
    n_i, n_j, n_k = volume.shape
    one = 1 << point
    half = one >> 1
    share = np.zeros((3, 2), np.int64)
    for row in range(image.shape[0]):
        for piece in range(2):
            for column in range(spans[row, piece, 0], spans[row, piece, 1] + 1):
                place = axes[:, 2] + row * axes[:, 1] + column * axes[:, 0]
                i, j, k = place >> point
                share[:, 1] = place & (one - 1)
                share[:, 0] = one - share[:, 1]
                if i < 0 or j < 0 or k < 0:
                    continue
                if (
                    i + (share[0, 1] != 0) >= n_i
                    or j + (share[1, 1] != 0) >= n_j
                    or k + (share[2, 1] != 0) >= n_k
                ):
                    continue
                level = int(image[row, column])
                for corner in range(7, -1, -1):
                    a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
                    f = (share[1, b] * share[2, c] + half) >> point
                    f = (share[0, a] * f + half) >> point
                    if f == 0:
                        continue
                    held, so_far = int(volume[i + a, j + b, k + c]), int(weight[i + a, j + b, k + c])
                    if rule == 0:
                        r = so_far << (point - 8)
                        mean = np.rint((f * level + r * held) / (f + r) * one)
                        volume[i + a, j + b, k + c] = (int(mean) + half) >> point
                        new = (f + r) << 8
                    elif 8 * f >= one and (rule == 2 or level > held):
                        volume[i + a, j + b, k + c] = level
                        new = f << 8
                    else:
                        continue
                    weight[i + a, j + b, k + c] = min((new + half) >> point, MOST)


def exact_mean(images, voxel_from_pixel, shape, clip, linear=False, true_places=False):
    """Mean of the same pixels without rounding, NaN where there are none, and their weight, both [i, j, k].

    Parameters
    ----------
    true_places : bool
        Take places as they are, not as multiples of 2^-14 voxel.
    """
    rows, columns = np.nonzero(clip.mask(images.shape[2], images.shape[1]))
    pixels = np.stack([columns, rows, np.ones_like(rows)])
    maps = np.asarray(voxel_from_pixel)[:, :, [0, 1, 3]]
    if not true_places:
        maps = np.rint(maps * 2.0**POINT) / 2.0**POINT
    total, weight = np.zeros(np.prod(shape)), np.zeros(np.prod(shape))
    for image, axes in zip(images, maps, strict=True):
        place, level = (axes @ pixels).T, image[rows, columns].astype(float)
        first = np.floor(place if linear else place + 0.5).astype(int)
        for corner in np.ndindex(2, 2, 2) if linear else [(0, 0, 0)]:
            index = first + corner
            share = np.prod(np.where(corner, place - first, 1 - place + first), axis=1) if linear else 1.0
            # A pixel near the border counts in none of the eight, as in IGSIO, not in those inside.
            reach = np.ceil(place).astype(int) if linear else index
            inside = ((first >= 0) & (reach < shape)).all(axis=1) & (share > 0)
            flat = np.ravel_multi_index(tuple(index[inside].T), shape)
            share = np.broadcast_to(share, level.shape)[inside]
            total += np.bincount(flat, share * level[inside], total.size)
            weight += np.bincount(flat, share, total.size)
    with np.errstate(invalid="ignore"):
        return (total / weight).reshape(shape), weight.reshape(shape)


@njit(cache=True, fastmath=False)
def _across(volume, weight, sticks, longest, filled):
    n_i, n_j, n_k = volume.shape
    for i in range(n_i):
        for j in range(n_j):
            for k in range(n_k):
                if weight[i, j, k]:
                    continue
                best, total, number = 0.0, 0.0, 0
                for stick in range(sticks.shape[0]):
                    step = sticks[stick]
                    reach = np.zeros(2, np.int64)
                    ends = np.zeros(2)
                    for side in range(2):
                        sign = 1 - 2 * side
                        for steps in range(1, longest - reach[0]):
                            x, y, z = (
                                i + sign * steps * step[0],
                                j + sign * steps * step[1],
                                k + sign * steps * step[2],
                            )
                            if not (0 <= x < n_i and 0 <= y < n_j and 0 <= z < n_k):
                                break
                            if weight[x, y, z]:
                                reach[side], ends[side] = steps, volume[x, y, z]
                                break
                        if reach[side] == 0:
                            break
                    if reach[1] == 0:
                        continue
                    all_steps = reach[0] + reach[1] + 1
                    ahead = (reach[1] + 1) / all_steps
                    score = 1.0 / (all_steps * np.sqrt(float((step**2).sum())))
                    value = np.floor((1.0 - ahead) * ends[1] + ahead * ends[0])
                    if score > best:
                        best, total, number = score, 0.0, 0
                    if score == best:
                        total += value * score
                        number += 1
                # A level that came with less than half of 1/256 of a weight is lost.
                filled[i, j, k] = int(total / (number * best)) if number else 0


def fill_with_sticks(volume, weight, longest=9):
    """Fill each hole across the shortest stick between measured voxels; equally short ones count alike."""
    filled = volume.copy()
    across = _across.py_func if volume.size < 10_000 else _across
    across(volume, weight, STICKS, longest, filled)
    return filled
