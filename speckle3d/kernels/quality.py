"""What tells speckle in the patches of a frame's intensity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp"})
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
    patch = np.empty((wide, high), np.float32)
    # Of the first samples, the one between and the last: sums and squares, by vector.
    sums, squares = np.empty((wide, 3)), np.empty((wide, 3))
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
        together = np.zeros(3)
        for v in range(wide):
            row = image[first[p, 0] + v, first[p, 1] : first[p, 1] + high]
            # Over the patch's own mean: neither precision nor range is then lost on any.
            varying = patch[v]
            for k in range(high):
                varying[k] = row[k] * scale - np.float32(1.0)
            for part in range(3):
                start = 0 if part == 0 else (half_high if part == 1 else high - half_high)
                stop = half_high if part == 0 else (high - half_high if part == 1 else high)
                part_sum: Any = np.float32(0.0)
                part_square: Any = np.float32(0.0)
                piece = varying[start:stop]
                for k in range(piece.size):
                    part_sum += piece[k]
                    part_square += piece[k] * piece[k]
                sums[v, part], squares[v, part] = part_sum, part_square
            product: Any = np.float32(0.0)
            later = varying[high - half_high :]
            for k in range(half_high):
                product += varying[k] * later[k]
            together[2] += product
            if v >= 1:
                before = patch[v - 1]
                product = np.float32(0.0)
                for k in range(high):
                    product += varying[k] * before[k]
                together[0] += product
            if v >= wide - half_wide:
                before = patch[v - (wide - half_wide)]
                product = np.float32(0.0)
                for k in range(high):
                    product += varying[k] * before[k]
                together[1] += product
        out[p, 0], out[p, 1] = mean, np.sqrt(squares.sum() / (wide * high))
        rows = sums.sum(axis=1)
        rows_squared = squares.sum(axis=1)
        out[p, 2] = _pearson(
            together[0],
            rows[:-1].sum(),
            rows[1:].sum(),
            rows_squared[:-1].sum(),
            rows_squared[1:].sum(),
            (wide - 1) * high,
        )
        out[p, 3] = _pearson(
            together[1],
            rows[:half_wide].sum(),
            rows[wide - half_wide :].sum(),
            rows_squared[:half_wide].sum(),
            rows_squared[wide - half_wide :].sum(),
            half_wide * high,
        )
        out[p, 4] = _pearson(
            together[2],
            sums[:, 0].sum(),
            sums[:, 2].sum(),
            squares[:, 0].sum(),
            squares[:, 2].sum(),
            wide * half_high,
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _pearson(ab: float, a: float, b: float, aa: float, bb: float, count: int) -> float:
    """Coefficient from sums of products, of either's values and of their squares."""
    a, b = a / count, b / count
    spread = np.sqrt((aa / count - a * a) * (bb / count - b * b))
    return float((ab / count - a * b) / spread)
