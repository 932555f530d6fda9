"""What tells speckle in the patches of a frame's intensity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray

_FAST = {"reassoc", "contract", "arcp"}


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def patch_statistics(image: Float32Array, first: IntArray, size: IntArray, out: FloatArray) -> None:
    """Fill ``out[p]`` with the mean, the contrast and three correlations of patch p.

    Parameters
    ----------
    image : float32, shape (vector, sample)
        Intensity.
    first : int64, shape (p, 2)
        First vector and sample of each patch, which lies inside the image.
    size : int64, shape (2,)
        Vectors and samples in a patch.
    out : float64, shape (p, 5)
        Mean; standard deviation over mean, about it; and Pearson's coefficient of each vector with the next,
        of the first vectors with the last, and of the first samples with the last. NaN where flat.
    """
    wide, high = size[0], size[1]
    half_wide, half_high = wide // 2, high // 2
    last_wide, last_high = wide - half_wide, high - half_high
    patch = np.empty((wide, high), np.float32)
    for p in range(first.shape[0]):
        total = 0.0
        for v in range(wide):
            row = image[first[p, 0] + v, first[p, 1] : first[p, 1] + high]
            row_sum: Any = np.float32(0.0)
            for k in range(high):
                row_sum += row[k]
            total += row_sum
        mean = np.float32(total / (wide * high))
        scale = np.float32(1.0) / mean
        # Sums a of values and aa of squares: of all, of the first and last vector, of halves either way.
        a = a_first = a_last = a_left = a_right = a_top = a_bottom = 0.0
        aa = aa_first = aa_last = aa_left = aa_right = aa_top = aa_bottom = 0.0
        alike = across = along = 0.0
        for v in range(wide):
            row = image[first[p, 0] + v, first[p, 1] : first[p, 1] + high]
            # Over the patch's own mean: neither precision nor range is then lost on any.
            varying = patch[v]
            for k in range(high):
                varying[k] = row[k] * scale - np.float32(1.0)
            above, below, middle = varying[:half_high], varying[last_high:], varying[half_high:last_high]
            x, xx, y, yy, xy = _products(above, below)
            z, zz, _, _, _ = _products(middle, middle)
            along += xy
            a_top += x
            aa_top += xx
            a_bottom += y
            aa_bottom += yy
            x, xx = x + y + z, xx + yy + zz
            a += x
            aa += xx
            if v == 0:
                a_first, aa_first = x, xx
            else:
                alike += _product(varying, patch[v - 1])
            if v == wide - 1:
                a_last, aa_last = x, xx
            if v < half_wide:
                a_left += x
                aa_left += xx
            if v >= last_wide:
                a_right += x
                aa_right += xx
                across += _product(varying, patch[v - last_wide])
        out[p, 0], out[p, 1] = mean, np.sqrt(aa / (wide * high))
        out[p, 2] = _pearson(alike, a - a_last, a - a_first, aa - aa_last, aa - aa_first, (wide - 1) * high)
        out[p, 3] = _pearson(across, a_left, a_right, aa_left, aa_right, half_wide * high)
        out[p, 4] = _pearson(along, a_top, a_bottom, aa_top, aa_bottom, wide * half_high)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _products(a: Float32Array, b: Float32Array) -> tuple[float, float, float, float, float]:
    """Sums of either's values and squares, and of their products."""
    x: Any = np.float32(0.0)
    y: Any = np.float32(0.0)
    xx: Any = np.float32(0.0)
    yy: Any = np.float32(0.0)
    xy: Any = np.float32(0.0)
    for k in range(a.size):
        x += a[k]
        xx += a[k] * a[k]
        y += b[k]
        yy += b[k] * b[k]
        xy += a[k] * b[k]
    return x, xx, y, yy, xy


@njit(cache=True, nogil=True, fastmath=_FAST)
def _product(a: Float32Array, b: Float32Array) -> float:
    total: Any = np.float32(0.0)
    for k in range(a.size):
        total += a[k] * b[k]
    return float(total)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _pearson(ab: float, a: float, b: float, aa: float, bb: float, count: int) -> float:
    """Coefficient from sums of products, of either's values and of their squares."""
    a, b = a / count, b / count
    spread = np.sqrt((aa / count - a * a) * (bb / count - b * b))
    return float((ab / count - a * b) / spread)
