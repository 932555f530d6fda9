"""Correlation of matching patches of two images at neighbouring lags."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

Float32Array = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"})
def patch_correlations(
    fixed: Float32Array,
    moving: Float32Array,
    first: IntArray,
    size: IntArray,
    shift: IntArray,
    least_overlap: float,
    out: FloatArray,
) -> None:
    """Fill ``out[p, i, j]`` with Pearson's coefficient of patch p at lag ``shift[p] + (i, j) - radius``.

    Parameters
    ----------
    fixed, moving : float32, shape (vector, sample)
    first : int64, shape (p, 2)
        First vector and sample of each patch in `fixed`.
    size : int64, shape (2,)
        Vectors and samples in a patch.
    shift : int64, shape (p, 2)
        Lag, in vectors and samples, about which to look in `moving`.
    least_overlap : float
        Share of a patch that must have a partner in `moving` at every lag; below it the patch is NaN.
    out : float64, shape (p, 2 * lateral radius + 1, 2 * axial radius + 1)
        NaN also where either patch is flat.
    """
    rows, columns = fixed.shape
    lateral_radius = out.shape[1] // 2
    axial_radius = out.shape[2] // 2
    for p in range(first.shape[0]):
        dv, ds = shift[p, 0], shift[p, 1]
        # The part of the patch that stays inside both images at every lag, so that all lags share it.
        v0 = max(first[p, 0], 0, lateral_radius - dv)
        v1 = min(first[p, 0] + size[0], rows, rows - lateral_radius - dv)
        s0 = max(first[p, 1], 0, axial_radius - ds)
        s1 = min(first[p, 1] + size[1], columns, columns - axial_radius - ds)
        n = (v1 - v0) * (s1 - s0)
        if v1 <= v0 or s1 <= s0 or n < least_overlap * size[0] * size[1]:
            out[p] = np.nan
            continue
        width = s1 - s0
        a_sum = 0.0
        aa_sum = 0.0
        for v in range(v0, v1):
            a_row = fixed[v, s0:s1]
            row_sum: Any = np.float32(0.0)
            row_square: Any = np.float32(0.0)
            for k in range(width):
                row_sum += a_row[k]
                row_square += a_row[k] * a_row[k]
            a_sum += row_sum
            aa_sum += row_square
        a_var = aa_sum - a_sum * a_sum / n
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                b_sum = 0.0
                bb_sum = 0.0
                ab_sum = 0.0
                start = s0 + ds + j - axial_radius
                for v in range(v0, v1):
                    a_row = fixed[v, s0:s1]
                    b_row = moving[v + dv + i - lateral_radius, start : start + width]
                    row_b: Any = np.float32(0.0)
                    row_bb: Any = np.float32(0.0)
                    row_ab: Any = np.float32(0.0)
                    for k in range(width):
                        row_b += b_row[k]
                        row_bb += b_row[k] * b_row[k]
                        row_ab += a_row[k] * b_row[k]
                    b_sum += row_b
                    bb_sum += row_bb
                    ab_sum += row_ab
                b_var = bb_sum - b_sum * b_sum / n
                # Float32 row sums leave about 1e-6 of the energy: less variance than that is a flat patch.
                if a_var > 1e-6 * aa_sum and b_var > 1e-6 * bb_sum:
                    out[p, i, j] = (ab_sum - a_sum * b_sum / n) / np.sqrt(a_var * b_var)
                else:
                    out[p, i, j] = np.nan
