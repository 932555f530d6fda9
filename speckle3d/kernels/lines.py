"""The straight line that most of some points agree on."""

from __future__ import annotations

import numpy as np
from numba import njit

from speckle3d.core.arrays import BoolArray, FloatArray

_ROUNDS = 20


@njit(cache=True, nogil=True, error_model="python", fastmath=False)
def agreeing(
    column: FloatArray,
    row: FloatArray,
    inside: BoolArray,
    start: float,
    slope: float,
    tolerance: float,
    agree: BoolArray,
) -> tuple[int, int, float]:
    """Find the points within a tolerance above or below a line, where the line is inside the region.

    Parameters
    ----------
    column, row : float64, shape (n,)
        Points; row NaN where there is none.
    inside : bool, shape (n, r)
        Which rows of each column belong to the region.
    start, slope : float
        The line's row in column 0, and rows per column.
    agree : bool, shape (n,)

    Returns
    -------
    tuple of int, int and float
        How many points agree, how many could, and the sum of squared deviations of those that agree.
    """
    agreed, possible, squares = 0, 0, 0.0
    for i in range(column.size):
        agree[i] = False
        at = start + slope * column[i]
        if not -0.5 <= at < inside.shape[1] - 0.5 or not inside[i, int(at + 0.5)]:
            continue
        possible += 1
        off = row[i] - at
        if abs(off) <= tolerance:
            agree[i] = True
            agreed += 1
            squares += off * off
    return agreed, possible, squares


@njit(cache=True, nogil=True, error_model="python", fastmath=False)
def consensus_line(
    column: FloatArray, row: FloatArray, inside: BoolArray, tolerance: float, agree: BoolArray
) -> tuple[int, float, float]:
    """Fit a line to the points that agree on it: those of the best pair's line, until they stay the same.

    Most points agree with the best pair's line; of equals, it is the one closest to them. Parameters are
    those of `agreeing`; `agree` is overwritten.

    Returns
    -------
    tuple of int, float and float
        How many points could agree, the line's row in column 0, and its slope; zeros without two points.
    """
    most, least, start, slope = 0, np.inf, 0.0, 0.0
    for j in range(column.size):
        for k in range(j + 1, column.size):
            if np.isnan(row[j]) or np.isnan(row[k]):
                continue
            rise = (row[k] - row[j]) / (column[k] - column[j])
            at = row[j] - rise * column[j]
            agreed, _, squares = agreeing(column, row, inside, at, rise, tolerance, agree)
            if agreed > most or (agreed == most and squares < least):
                most, least, start, slope = agreed, squares, at, rise
    agreed, possible, _ = agreeing(column, row, inside, start, slope, tolerance, agree)
    before = np.empty_like(agree)
    for _ in range(_ROUNDS):
        if agreed < 3:
            break
        before[:] = agree
        x, y = column[before], row[before]
        away = x - x.mean()
        slope = (away * y).sum() / (away * away).sum()
        start = y.mean() - slope * x.mean()
        agreed, possible, _ = agreeing(column, row, inside, start, slope, tolerance, agree)
        if (before == agree).all():
            break
    return possible, start, slope
