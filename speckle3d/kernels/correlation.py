"""Correlation of matching patches of two images, or of their complex echoes, at neighbouring lags.

A patch and its neighbourhood in the other frame are copied into rows of one padded length. What both have in
common at a lag is then one long sum of products, the other's rows beginning so much later; the padding, zero
in the patch, adds nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray

_LANES = 16
"""Rows are padded to a multiple of this many samples: a vector register's."""
_TOGETHER = 8
"""Rows whose sums are taken in float32; more would leave too much of a flat patch's variance."""

Buffers = tuple[Float32Array, Float32Array, Float32Array]


@njit(cache=True, nogil=True)
def _stride(size: IntArray, axial_radius: int) -> int:
    """Length of padded rows."""
    return (size[1] + 2 * axial_radius + _LANES - 1) // _LANES * _LANES


@njit(cache=True, nogil=True)
def buffers(size: IntArray, lateral_radius: int, axial_radius: int) -> Buffers:
    """Room for the real and imaginary parts of a patch and of its neighbourhood, and for what it covers.

    Returns
    -------
    float32, shape (2, rows * stride)
        The patch, or intensity and nothing.
    float32, shape (2, (rows + 2 * lateral_radius + 1) * stride)
    float32, shape (rows * stride + 1,)
        One at the patch's samples, zero at its rows' padding; last the width of rows it was made for.
    """
    stride = _stride(size, axial_radius)
    rows = size[0] + 2 * lateral_radius + 1
    return (
        np.zeros((2, size[0] * stride), np.float32),
        np.zeros((2, rows * stride), np.float32),
        np.zeros(size[0] * stride + 1, np.float32),
    )


@njit(cache=True, nogil=True)
def _common(first: int, size: int, length: int, radius: int, shift: int) -> tuple[int, int]:
    """Start and end of what stays inside both images at every lag, so that all lags share it."""
    return max(first, 0, radius - shift), min(first + size, length, length - radius - shift)


@njit(cache=True, nogil=True)
def _copy(image: Float32Array, v: int, s: int, rows: int, width: int, stride: int, out: Float32Array) -> None:
    """Copy a window to rows `stride` apart; zeros behind each, and in one row more."""
    for k in range(rows):
        source, row = image[v + k, s : s + width], out[k * stride : (k + 1) * stride]
        for n in range(width):
            row[n] = source[n]
        for n in range(width, stride):
            row[n] = np.float32(0.0)
    behind = out[rows * stride : (rows + 1) * stride]
    for n in range(behind.size):
        behind[n] = np.float32(0.0)


@njit(cache=True, nogil=True)
def _cover(width: int, stride: int, inside: Float32Array) -> None:
    """Mark the first samples of each row, unless they are marked already."""
    if inside[-1] != width:
        for k in range(inside.size - 1):
            inside[k] = np.float32(1.0 if k % stride < width else 0.0)
        inside[-1] = np.float32(width)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"})
def _sums(a: Float32Array, b: Float32Array, inside: Float32Array, chunk: int) -> tuple[float, float, float]:
    """Sum of a b, of b and of its square where `inside` is one."""
    product, total, square = 0.0, 0.0, 0.0
    for start in range(0, a.size, chunk):
        end = min(start + chunk, a.size)
        part, other, weight = a[start:end], b[start:end], inside[start:end]
        some_product: Any = np.float32(0.0)
        some: Any = np.float32(0.0)
        some_square: Any = np.float32(0.0)
        for k in range(part.size):
            value = weight[k] * other[k]
            some_product += part[k] * other[k]
            some += value
            some_square += value * other[k]
        product += some_product
        total += some
        square += some_square
    return product, total, square


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"})
def _echo_sums(
    a: Float32Array, ai: Float32Array, b: Float32Array, bi: Float32Array, inside: Float32Array
) -> tuple[float, float, float]:
    """Real and imaginary part of the sum of conj(a) b, and of the power of b where `inside` is one."""
    in_phase: Any = np.float32(0.0)
    quadrature: Any = np.float32(0.0)
    power: Any = np.float32(0.0)
    for k in range(a.size):
        in_phase += a[k] * b[k] + ai[k] * bi[k]
        quadrature += a[k] * bi[k] - ai[k] * b[k]
        power += inside[k] * (b[k] * b[k] + bi[k] * bi[k])
    return float(in_phase), float(quadrature), float(power)


@njit(cache=True, nogil=True)
def correlate_patch(
    fixed: Float32Array,
    moving: Float32Array,
    first: IntArray,
    size: IntArray,
    shift: IntArray,
    least_overlap: float,
    corners: bool,
    room: Buffers,
    out: FloatArray,
) -> None:
    """Fill ``out[i, j]`` for one patch as `patch_correlations` does, in `buffers`."""
    lateral, axial = out.shape[0] // 2, out.shape[1] // 2
    v0, v1 = _common(first[0], size[0], fixed.shape[0], lateral, shift[0])
    s0, s1 = _common(first[1], size[1], fixed.shape[1], axial, shift[1])
    rows, width = v1 - v0, s1 - s0
    n, stride = rows * width, room[0].shape[1] // size[0]
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = np.nan
    if rows <= 0 or width <= 0 or n < least_overlap * size[0] * size[1]:
        return
    end, chunk = rows * stride, _TOGETHER * stride
    a, b, inside = room[0][0, :end], room[1][0], room[2][:end]
    _copy(fixed, v0, s0, rows, width, stride, a)
    v, s = v0 + shift[0] - lateral, s0 + shift[1] - axial
    _copy(moving, v, s, rows + 2 * lateral, width + 2 * axial, stride, b)
    _cover(width, stride, room[2])
    aa_sum, a_sum, _ = _sums(a, a, inside, chunk)
    a_var = aa_sum - a_sum * a_sum / n
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            if not corners and i != lateral and j != axial:
                continue
            start = i * stride + j
            ab_sum, b_sum, bb_sum = _sums(a, b[start : start + end], inside, chunk)
            b_var = bb_sum - b_sum * b_sum / n
            # Float32 sums leave about 1e-6 of the energy: less variance than that is a flat patch.
            if a_var > 1e-6 * aa_sum and b_var > 1e-6 * bb_sum:
                out[i, j] = (ab_sum - a_sum * b_sum / n) / np.sqrt(a_var * b_var)


@njit(cache=True, nogil=True)
def turns(size: IntArray, axial_radius: int, ramp_rad: FloatArray) -> Float32Array:
    """Cosine and sine of a ramp's phase at the samples of a patch in `buffers`, shape (2, rows * stride)."""
    stride = _stride(size, axial_radius)
    out = np.empty((2, size[0] * stride), np.float32)
    across, along = np.exp(1j * ramp_rad[0]), np.exp(1j * ramp_rad[1])
    start = complex(1.0)
    for v in range(size[0]):
        phase = start
        for k in range(v * stride, (v + 1) * stride):
            out[0, k], out[1, k] = phase.real, phase.imag
            phase *= along
        start *= across
    return out


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"})
def _turn(a: Float32Array, ai: Float32Array, cosine: Float32Array, sine: Float32Array) -> float:
    """Turn a patch's echo back by the ramp's phase, in place; return its power."""
    power: Any = np.float32(0.0)
    for k in range(a.size):
        real, imaginary = a[k], ai[k]
        power += real * real + imaginary * imaginary
        a[k] = real * cosine[k] + imaginary * sine[k]
        ai[k] = imaginary * cosine[k] - real * sine[k]
    return float(power)


@njit(cache=True, nogil=True)
def cohere_patch(
    fixed: Float32Array,
    moving: Float32Array,
    first: IntArray,
    size: IntArray,
    shift: IntArray,
    turn: Float32Array,
    least_overlap: float,
    corners: bool,
    room: Buffers,
    out: FloatArray,
) -> None:
    """Fill ``out[i, j]`` for one patch as `patch_coherences` does, in `buffers`, with a ramp's `turns`."""
    lateral, axial = out.shape[0] // 2, out.shape[1] // 2
    v0, v1 = _common(first[0], size[0], fixed.shape[1], lateral, shift[0])
    s0, s1 = _common(first[1], size[1], fixed.shape[2], axial, shift[1])
    rows, width, stride = v1 - v0, s1 - s0, room[0].shape[1] // size[0]
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = np.nan
    if rows <= 0 or width <= 0 or rows * width < least_overlap * size[0] * size[1]:
        return
    end = rows * stride
    a, ai, inside = room[0][0, :end], room[0][1, :end], room[2][:end]
    b, bi = room[1][0], room[1][1]
    v, s = v0 + shift[0] - lateral, s0 + shift[1] - axial
    for k in range(2):
        _copy(fixed[k], v0, s0, rows, width, stride, room[0][k, :end])
        _copy(moving[k], v, s, rows + 2 * lateral, width + 2 * axial, stride, room[1][k])
    _cover(width, stride, room[2])
    power = _turn(a, ai, turn[0], turn[1])
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            if not corners and i != lateral and j != axial:
                continue
            start = i * stride + j
            in_phase, quadrature, other = _echo_sums(
                a, ai, b[start : start + end], bi[start : start + end], inside
            )
            if power * other > 0.0:
                out[i, j] = (in_phase**2 + quadrature**2) / (power * other)


@njit(cache=True, nogil=True)
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
    room = buffers(size, out.shape[1] // 2, out.shape[2] // 2)
    for p in range(first.shape[0]):
        correlate_patch(fixed, moving, first[p], size, shift[p], least_overlap, corners, room, out[p])


@njit(cache=True, nogil=True)
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
    room = buffers(size, out.shape[1] // 2, out.shape[2] // 2)
    turn = turns(size, out.shape[2] // 2, ramp_rad)
    for p in range(first.shape[0]):
        cohere_patch(fixed, moving, first[p], size, shift[p], turn, least_overlap, corners, room, out[p])
