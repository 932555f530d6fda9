"""Where in an image to look for a line: columns at regular intervals, and which of their rows count."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import require_finite
from speckle3d.core.sweep import Frames

_GLANCES = 48
"""Frames looked at for what stands still in all of them."""
DENSELY = 4
"""How many times the columns asked for are looked at to learn which of them show anything."""
_LIVELY = 0.25
"""Change that counts, as a part of the strongest change in nearly all columns."""


@dataclass(frozen=True)
class Columns:
    """Sampled columns and their part in a region.

    Attributes
    ----------
    column : ndarray of int, shape (n,)
        Numbers of the columns, ascending.
    inside : ndarray of bool, shape (n, r)
        Which rows of each are in the region.
    spans : ndarray of int, shape (s, 3)
        The same as runs: place in `column`, first and last row.
    """

    column: IntArray
    inside: BoolArray
    spans: IntArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        ends = np.diff(np.pad(self.inside, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        place, first = np.nonzero(ends == 1)
        spans = np.stack([place, first, np.nonzero(ends == -1)[1] - 1], axis=1)
        object.__setattr__(self, "spans", spans.astype(np.int64))

    def thinned(self, count: int) -> Columns:
        """So many of the columns with rows in the region, evenly spread."""
        place = np.flatnonzero(self.inside.any(axis=1))
        place = place[_spread(place.size, count)] if place.size else place
        return Columns(self.column[place], self.inside[place])

    @property
    def held(self) -> int:
        """How many columns have rows in the region."""
        return int(self.inside.any(axis=1).sum())

    def narrowed(self, inside: BoolArray) -> Columns:
        """These columns with the rows that are in both regions."""
        return Columns(self.column, self.inside & inside)


def lay_columns(shape: tuple[int, ...], count: int, region_px: npt.ArrayLike | None) -> Columns:
    """Spread columns over an image, or over a polygon in it, symmetric about its middle.

    Parameters
    ----------
    shape : tuple of int
        Columns and rows of the image.
    count : int
        Columns to sample; fewer where there are not so many.
    region_px : array_like, shape (k, 2), optional
        Corners (column, row) of any simple polygon.

    Raises
    ------
    InvalidInputError
        If the region is not a polygon, or covers nothing.
    """
    columns, rows = shape
    region = None if region_px is None else _checked_region(region_px)
    first, last = 0, columns - 1
    if region is not None:
        first = max(first, int(np.ceil(region[:, 0].min())))
        last = min(last, int(np.floor(region[:, 0].max())))
    column = first + _spread(max(last - first + 1, 1), count)
    inside = np.ones((column.size, rows), dtype=bool)
    if region is not None:
        inside = np.array([_rows_inside(region, c, rows) for c in column])
    if last <= first or not inside.any():
        raise InvalidInputError(
            f"region_px: expected a polygon that covers part of the {columns} x {rows} pixels, got none"
        )
    return Columns(column, inside)


def without_blank_sides(columns: Columns, image: npt.NDArray[Any]) -> Columns:
    """Leave out columns of one level at the sides of an image (column, row): the fan does not reach them."""
    sampled = np.asarray(image[columns.column], np.float32)
    blank = np.ptp(sampled, axis=1) == 0
    sides = np.logical_and.accumulate(blank) | np.logical_and.accumulate(blank[::-1])[::-1]
    return columns.narrowed(~sides[:, None])


def without_standing(columns: Columns, frames: Frames, smoothing_rows: float) -> Columns:
    """Leave out columns in which nothing changes, and what is bright and stands still above all change.

    The floor moves: lettering, a screen's border and the transducer's ring-down do not. Dark water stays in,
    since the floor may come shallower in frames that were not looked at. Where all frames are alike, all
    stays in.
    """
    glances = np.unique(np.linspace(0, frames.shape[0] - 1, _GLANCES).astype(int))
    low, high = np.full((2, *columns.inside.shape), np.nan, np.float32)
    for index in glances:
        image = np.asarray(frames[int(index)][columns.column], np.float32)
        low, high = np.fmin(low, image), np.fmax(high, image)
    low, high = np.nan_to_num(low), np.nan_to_num(high)
    change, level = (gaussian_filter1d(x, smoothing_rows / 2, axis=1) for x in (high - low, low - low.min()))
    limit = _LIVELY * np.percentile(change.max(axis=1), 90)
    if not limit > 0:
        return columns
    lively = change > limit
    standing = (level > limit) & ~np.logical_or.accumulate(lively, axis=1)
    under = ~np.logical_or.accumulate(standing[:, ::-1], axis=1)[:, ::-1]
    return columns.narrowed(under & lively.any(axis=1)[:, None])


def _spread(size: int, count: int) -> IntArray:
    """About `count` of the numbers below `size`, at regular intervals and symmetric about their middle."""
    left = np.rint(np.linspace(0, size - 1, count)[: (count + 1) // 2]).astype(np.int64)
    return np.unique(np.concatenate([left, size - 1 - left]))


def _checked_region(region_px: npt.ArrayLike) -> FloatArray:
    region = np.asarray(region_px, dtype=float)
    if region.ndim != 2 or region.shape[0] < 3 or region.shape[1] != 2:
        raise InvalidInputError(f"region_px: expected shape (k, 2) with k of 3 or more, got {region.shape}")
    require_finite(region, "region_px")
    return region


def _rows_inside(region: FloatArray, column: int, rows: int) -> BoolArray:
    """Rows of a column within a polygon: between every other crossing of its sides."""
    middle = (region[:, 0].min() + region[:, 0].max()) / 2
    # A hair towards the middle, so that the first and the last column have rows however the corners lie.
    u = column + 1e-9 * (middle - column)
    (x0, y0), (x1, y1) = region.T, np.roll(region, -1, axis=0).T
    crossed = (np.minimum(x0, x1) <= u) & (u < np.maximum(x0, x1))
    x0, y0, x1, y1 = (values[crossed] for values in (x0, y0, x1, y1))
    crossings = y0 + (u - x0) * (y1 - y0) / (x1 - x0)
    row = np.arange(rows)[:, None]
    # Counted from either end, so that rows exactly on a side are inside.
    from_above = (crossings <= row + 1e-6).sum(axis=1) % 2 == 1
    from_below = (crossings >= row - 1e-6).sum(axis=1) % 2 == 1
    return np.asarray(from_above | from_below)
