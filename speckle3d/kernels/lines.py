"""Edges along the columns of an image, and the straight line most of them agree on."""

from __future__ import annotations

import numpy as np
from numba import njit

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray

_ROUNDS = 20


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def filter_columns(
    samples: Float32Array, spans: IntArray, middle: float, taps: Float32Array, sign: float, out: Float32Array
) -> None:
    """Correlate each span of a column with an even or odd filter, the end values continued beyond the ends.

    Parameters
    ----------
    samples : float32, shape (n, r)
        Columns of an image.
    spans : int64, shape (s, 3)
        Column, first and last row.
    middle : float
        Weight of the row itself.
    taps : float32, shape (h,)
        Weights of the rows 1, 2, ... h below; those above have them times `sign`.
    out : float32, shape (n, r)
        Zero outside the spans.
    """
    out[:] = 0.0
    reach = taps.size
    turned = np.float32(sign)
    padded = np.empty(samples.shape[1] + 2 * reach, np.float32)
    for s in range(spans.shape[0]):
        c, first, last = spans[s]
        size = last - first + 1
        padded[:reach] = samples[c, first]
        padded[reach : reach + size] = samples[c, first : last + 1]
        padded[reach + size : size + 2 * reach] = samples[c, last]
        line = out[c, first : last + 1]
        line[:] = np.float32(middle) * padded[reach : reach + size]
        for t in range(1, reach + 1):
            weight = taps[t - 1]
            below = padded[reach + t : reach + t + size]
            above = padded[reach - t : reach - t + size]
            for j in range(size):
                line[j] += weight * (below[j] + turned * above[j])


@njit(cache=True, nogil=True, error_model="python", fastmath=False)
def echo_levels(
    response: Float32Array,
    levels: Float32Array,
    spans: IntArray,
    least: float,
    dark: float,
    ahead: int,
    out: Float32Array,
) -> None:
    """Fill in the brightness of the echo that begins at each maximum of the response.

    Parameters
    ----------
    response, levels : float32, shape (n, r)
    spans : int64, shape (s, 3)
    least : float
        Response that a maximum must exceed.
    dark : float
        Level subtracted.
    ahead : int
        Rows below the maximum in which the brightest level is looked for.
    out : float32, shape (n, r)
        Zero where there is no maximum.
    """
    out[:] = 0.0
    for s in range(spans.shape[0]):
        c, first, last = spans[s]
        line = response[c]
        for j in range(first + 1, last):
            if line[j] > least and line[j] > line[j - 1] and line[j] >= line[j + 1]:
                out[c, j] = max(levels[c, j : min(j + ahead, last) + 1].max() - dark, 0.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def first_edges(
    response: Float32Array,
    score: Float32Array,
    spans: IntArray,
    threshold: float,
    rows: FloatArray,
    largest: FloatArray,
    found: IntArray,
) -> None:
    """Find the first maximum of each column's response whose score exceeds a threshold, or else the best.

    Parameters
    ----------
    response, score : float32, shape (n, r)
    spans : int64, shape (s, 3)
        By column, then by row.
    rows : float64, shape (n,)
        Of the maximum, between samples by a parabola; NaN without any.
    largest : float64, shape (n,)
        Its score; 0 without any.
    found : int64, shape (n,)
        The span it lies in; -1 without any.
    """
    rows[:] = np.nan
    found[:] = -1
    largest[:] = 0.0
    for s in range(spans.shape[0]):
        c, first, last = spans[s]
        line = response[c]
        for j in range(first + 1, last):
            here = line[j]
            if score[c, j] <= largest[c] or here <= line[j - 1] or here < line[j + 1]:
                continue
            if largest[c] > threshold:
                break
            largest[c] = score[c, j]
            found[c] = s
            bend = line[j - 1] - 2.0 * here + line[j + 1]
            rows[c] = j + 0.5 * (line[j - 1] - line[j + 1]) / bend


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def echo_fronts(
    levels: Float32Array,
    spans: IntArray,
    found: IntArray,
    edges: FloatArray,
    sigma: float,
    fronts: FloatArray,
    peaks: FloatArray,
) -> None:
    """Find where the echo behind each edge has risen half way, and where it is brightest.

    Parameters
    ----------
    levels : float32, shape (n, r)
    spans : int64, shape (s, 3)
    found : int64, shape (n,)
        The span each edge lies in; -1 where there is none.
    edges : float64, shape (n,)
        Rows of the edges, found with a Gaussian of `sigma` rows: up to `sigma` above the echo.
    fronts, peaks : float64, shape (n,)
        Rows; NaN without an echo.
    """
    for c in range(edges.size):
        fronts[c] = peaks[c] = np.nan
        if found[c] < 0:
            continue
        _, first, last = spans[found[c]]
        top = max(first, int(np.floor(edges[c] - 2.5 * sigma)))
        profile = levels[c, top : min(last, int(np.ceil(edges[c] + 2.0 * sigma))) + 1]
        before = min(max(1, int(edges[c] - sigma) - top + 1), profile.size)
        k = min(max(0, int(edges[c] - 0.5 * sigma) - top), profile.size - 1)
        k += np.argmax(profile[k:])
        half = 0.5 * (profile[:before].mean() + profile[k])
        if not profile[k] > half:
            continue
        peaks[c] = top + k
        if 0 < k < profile.size - 1:
            bend = profile[k - 1] - 2.0 * profile[k] + profile[k + 1]
            if bend < 0.0:
                peaks[c] += 0.5 * (profile[k - 1] - profile[k + 1]) / bend
        while k > 0 and profile[k - 1] >= half:
            k -= 1
        if k > 0:
            fronts[c] = top + k - (profile[k] - half) / (profile[k] - profile[k - 1])


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
def best_pair(
    column: FloatArray, row: FloatArray, inside: BoolArray, tolerance: float, agree: BoolArray
) -> tuple[float, float]:
    """Find the line through two points that most points agree with; of equals, the one closest to them.

    Parameters are those of `agreeing`; `agree` is overwritten.

    Returns
    -------
    tuple of float
        The line's row in column 0, and its slope; zeros without two points.
    """
    most, least, best_start, best_slope = 0, np.inf, 0.0, 0.0
    for j in range(column.size):
        if np.isnan(row[j]):
            continue
        for k in range(j + 1, column.size):
            if np.isnan(row[k]):
                continue
            slope = (row[k] - row[j]) / (column[k] - column[j])
            start = row[j] - slope * column[j]
            agreed, _, squares = agreeing(column, row, inside, start, slope, tolerance, agree)
            if agreed > most or (agreed == most and squares < least):
                most, least, best_start, best_slope = agreed, squares, start, slope
    return best_start, best_slope


@njit(cache=True, nogil=True, error_model="python", fastmath=False)
def consensus_line(
    column: FloatArray, row: FloatArray, inside: BoolArray, tolerance: float, agree: BoolArray
) -> tuple[int, float, float]:
    """Fit a line to the points that agree with the best pair's line, until these stay the same.

    Parameters are those of `agreeing`.

    Returns
    -------
    tuple of int, float and float
        How many points could agree, the line's row in column 0, and its slope.
    """
    start, slope = best_pair(column, row, inside, tolerance, agree)
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
