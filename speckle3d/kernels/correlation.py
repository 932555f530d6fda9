"""Correlation of matching patches of two images, or of their complex echoes, at neighbouring lags."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray


@njit(cache=True, nogil=True)
def _common(first: int, size: int, length: int, radius: int, shift: int) -> tuple[int, int]:
    """Start and end of what stays inside both images at every lag, so that all lags share it."""
    return max(first, 0, radius - shift), min(first + size, length, length - radius - shift)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"})
def patch_correlations(
    fixed: Float32Array,
    moving: Float32Array,
    first: IntArray,
    size: IntArray,
    shift: IntArray,
    least_overlap: float,
    out: FloatArray,
    corners: bool = True,
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
    corners : bool
        Whether to fill lags that are off the centre both ways; else they are NaN, for half the work.
    """
    lateral_radius = out.shape[1] // 2
    axial_radius = out.shape[2] // 2
    for p in range(first.shape[0]):
        dv, ds = shift[p, 0], shift[p, 1]
        v0, v1 = _common(first[p, 0], size[0], fixed.shape[0], lateral_radius, dv)
        s0, s1 = _common(first[p, 1], size[1], fixed.shape[1], axial_radius, ds)
        n, width = (v1 - v0) * (s1 - s0), s1 - s0
        if v1 <= v0 or s1 <= s0 or n < least_overlap * size[0] * size[1]:
            out[p] = np.nan
            continue
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
                if not corners and i != lateral_radius and j != axial_radius:
                    out[p, i, j] = np.nan
                    continue
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


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"})
def patch_coherences(
    fixed: Float32Array,
    moving: Float32Array,
    first: IntArray,
    size: IntArray,
    shift: IntArray,
    ramp_rad: FloatArray,
    least_overlap: float,
    out: FloatArray,
    corners: bool = True,
) -> None:
    """Fill ``out[p, i, j]`` with the squared coherence of patch p at lag ``shift[p] + (i, j) - radius``.

    Parameters
    ----------
    fixed, moving : float32, shape (2, vector, sample)
        Real and imaginary parts of the echo.
    ramp_rad : float64, shape (2,)
        By how much the phase of `moving` falls behind from vector to vector and from sample to sample.
    first, size, shift, least_overlap, out, corners
        As for `patch_correlations`.
    """
    lateral_radius = out.shape[1] // 2
    axial_radius = out.shape[2] // 2
    real, imaginary = np.empty(size[1], np.float32), np.empty(size[1], np.float32)
    sums = np.empty((out.shape[1], out.shape[2], 3))
    cosine, sine = np.empty(size[1], np.float32), np.empty(size[1], np.float32)
    for k in range(size[1]):
        cosine[k], sine[k] = np.cos(ramp_rad[1] * k), np.sin(ramp_rad[1] * k)
    for p in range(first.shape[0]):
        dv, ds = shift[p, 0], shift[p, 1]
        v0, v1 = _common(first[p, 0], size[0], fixed.shape[1], lateral_radius, dv)
        s0, s1 = _common(first[p, 1], size[1], fixed.shape[2], axial_radius, ds)
        n, width = (v1 - v0) * (s1 - s0), s1 - s0
        if v1 <= v0 or s1 <= s0 or n < least_overlap * size[0] * size[1]:
            out[p] = np.nan
            continue
        sums[:] = 0.0
        power = 0.0
        for v in range(v0, v1):
            a_real, a_imaginary = fixed[0, v, s0:s1], fixed[1, v, s0:s1]
            c: Any = np.float32(np.cos(ramp_rad[0] * (v - v0)))
            s: Any = np.float32(np.sin(ramp_rad[0] * (v - v0)))
            row_power: Any = np.float32(0.0)
            for k in range(width):
                turn_real = c * cosine[k] - s * sine[k]
                turn_imaginary = c * sine[k] + s * cosine[k]
                real[k] = a_real[k] * turn_real + a_imaginary[k] * turn_imaginary
                imaginary[k] = a_imaginary[k] * turn_real - a_real[k] * turn_imaginary
                row_power += a_real[k] * a_real[k] + a_imaginary[k] * a_imaginary[k]
            power += row_power
            for i in range(out.shape[1]):
                for j in range(out.shape[2]):
                    if not corners and i != lateral_radius and j != axial_radius:
                        continue
                    start = s0 + ds + j - axial_radius
                    row = v + dv + i - lateral_radius
                    b_real = moving[0, row, start : start + width]
                    b_imaginary = moving[1, row, start : start + width]
                    in_phase: Any = np.float32(0.0)
                    quadrature: Any = np.float32(0.0)
                    other_power: Any = np.float32(0.0)
                    for k in range(width):
                        in_phase += real[k] * b_real[k] + imaginary[k] * b_imaginary[k]
                        quadrature += real[k] * b_imaginary[k] - imaginary[k] * b_real[k]
                        other_power += b_real[k] * b_real[k] + b_imaginary[k] * b_imaginary[k]
                    sums[i, j, 0] += in_phase
                    sums[i, j, 1] += quadrature
                    sums[i, j, 2] += other_power
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                energy = power * sums[i, j, 2]
                together = sums[i, j, 0] ** 2 + sums[i, j, 1] ** 2
                out[p, i, j] = together / energy if energy > 0.0 else np.nan
