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
_TOGETHER = 4
"""Rows whose sums are taken in float32; more would leave too much of a flat patch's variance."""

Buffers = tuple[Float32Array, Float32Array, Float32Array, FloatArray]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _stride(size: IntArray, axial_radius: int) -> int:
    """Length of padded rows."""
    return int((size[1] + 2 * axial_radius + _LANES - 1) // _LANES * _LANES)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def buffers(size: IntArray, lateral_radius: int, axial_radius: int) -> Buffers:
    """Room for the real and imaginary parts of a patch and of its neighbourhood, and for what it covers.

    Returns
    -------
    float32, shape (2, rows * stride)
        The patch, or intensity and nothing.
    float32, shape (2, (rows + 2 * lateral_radius + 1) * stride)
    float32, shape (rows * stride + 1,)
        One at the patch's samples, zero at its rows' padding; last the width of rows it was made for.
    float64, shape (rows + 2 * lateral_radius, 2 * axial_radius + 1)
        Power of the neighbourhood's rows at each axial lag.
    """
    stride = _stride(size, axial_radius)
    rows = size[0] + 2 * lateral_radius + 1
    return (
        np.zeros((2, size[0] * stride), np.float32),
        np.zeros((2, rows * stride), np.float32),
        np.zeros(size[0] * stride + 1, np.float32),
        np.zeros((size[0] + 2 * lateral_radius, 2 * axial_radius + 1)),
    )


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _common(first: int, size: int, length: int, radius: int, shift: int) -> tuple[int, int]:
    """Start and end of what stays inside both images at every lag, so that all lags share it."""
    return max(first, 0, radius - shift), min(first + size, length, length - radius - shift)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _copy(
    image: Float32Array, corner: tuple[int, int], rows: int, width: int, stride: int, out: Float32Array
) -> None:
    """Copy a window to rows `stride` apart; zeros behind each, and in one row more if there is room."""
    # Unsigned indices are not tested for being negative, and slices would count their references.
    v, s, at = np.uint64(corner[0]), np.uint64(corner[1]), np.uint64(0)
    for _ in range(rows):
        for n in range(np.uint64(width)):
            out[at + n] = image[v, s + n]
        for n in range(np.uint64(width), np.uint64(stride)):
            out[at + n] = np.float32(0.0)
        at += np.uint64(stride)
        v += np.uint64(1)
    for n in range(at, np.uint64(min(out.size, (rows + 1) * stride))):
        out[n] = np.float32(0.0)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _cover(width: int, stride: int, inside: Float32Array) -> None:
    """Mark the first samples of each row, unless they are marked already."""
    if inside[-1] != width:
        for k in range(inside.size - 1):
            inside[k] = np.float32(1.0 if k % stride < width else 0.0)
        inside[-1] = np.float32(width)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"}, error_model="numpy")
def _sums(
    a: Float32Array, b: Float32Array, start: int, inside: Float32Array, end: int, chunk: int
) -> tuple[float, float, float]:
    """Sum of a b, of b and of its square where `inside` is one, b beginning with its sample `start`."""
    product, total, square = 0.0, 0.0, 0.0
    behind = np.uint64(start)
    for first in range(0, end, chunk):
        some_product: Any = np.float32(0.0)
        some: Any = np.float32(0.0)
        some_square: Any = np.float32(0.0)
        for k in range(np.uint64(first), np.uint64(min(first + chunk, end))):
            other = b[behind + k]
            value = inside[k] * other
            some_product += a[k] * other
            some += value
            some_square += value * other
        product += some_product
        total += some
        square += some_square
    return product, total, square


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"}, error_model="numpy")
def _echo_product(
    a: Float32Array, ai: Float32Array, b: Float32Array, bi: Float32Array, start: int, end: int, chunk: int
) -> tuple[float, float]:
    """Real and imaginary part of the sum of conj(a) b, b beginning with its sample `start`."""
    in_phase, quadrature, behind = 0.0, 0.0, np.uint64(start)
    for first in range(0, end, chunk):
        some: Any = np.float32(0.0)
        across: Any = np.float32(0.0)
        for k in range(np.uint64(first), np.uint64(min(first + chunk, end))):
            real, imaginary = b[behind + k], bi[behind + k]
            some += a[k] * real + ai[k] * imaginary
            across += a[k] * imaginary - ai[k] * real
        in_phase += some
        quadrature += across
    return in_phase, quadrature


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"}, error_model="numpy")
def _powers(b: Float32Array, bi: Float32Array, rows: int, stride: int, width: int, out: FloatArray) -> None:
    """Power of `width` samples of each row from its first, its second ... sample on."""
    lags = out.shape[1]
    for v in range(rows):
        start = np.uint64(v * stride)
        shared: Any = np.float32(0.0)
        for k in range(start + np.uint64(lags - 1), start + np.uint64(width)):
            shared += b[k] * b[k] + bi[k] * bi[k]
        for j in range(lags):
            power = float(shared)
            # Before what all lags share, and behind it.
            for k in range(j, min(lags - 1, j + width)):
                at = start + np.uint64(k)
                power += b[at] * b[at] + bi[at] * bi[at]
            for k in range(max(width, lags - 1), j + width):
                at = start + np.uint64(k)
                power += b[at] * b[at] + bi[at] * bi[at]
            out[v, j] = power


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
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
    """Fill ``out[i, j]`` with Pearson's coefficient of one patch at lag ``shift + (i, j) - radius``.

    Parameters
    ----------
    fixed, moving : float32, shape (vector, sample)
    first, size : int64, shape (2,)
        First vector and sample of the patch in `fixed`, and how many it has.
    shift : int64, shape (2,)
        Lag, in vectors and samples, about which to look in `moving`.
    least_overlap : float
        Share of the patch that must have a partner in `moving` at every lag; below it all is NaN.
    corners : bool
        Whether to fill lags that are off the centre both ways; else they are NaN, for half the work.
    room : tuple of ndarray
        From `buffers`.
    out : float64, shape (2 * lateral radius + 1, 2 * axial radius + 1)
        NaN also where either patch is flat.
    """
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
    a, b, inside = room[0][0], room[1][0], room[2]
    _copy(fixed, (v0, s0), rows, width, stride, a)
    corner = v0 + shift[0] - lateral, s0 + shift[1] - axial
    _copy(moving, corner, rows + 2 * lateral, width + 2 * axial, stride, b)
    _cover(width, stride, inside)
    aa_sum, a_sum, _ = _sums(a, a, 0, inside, end, chunk)
    a_var = aa_sum - a_sum * a_sum / n
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            if not corners and i != lateral and j != axial:
                continue
            ab_sum, b_sum, bb_sum = _sums(a, b, i * stride + j, inside, end, chunk)
            b_var = bb_sum - b_sum * b_sum / n
            # Float32 sums leave about 1e-6 of the energy: less variance than that is a flat patch.
            if a_var > 1e-6 * aa_sum and b_var > 1e-6 * bb_sum:
                out[i, j] = (ab_sum - a_sum * b_sum / n) / np.sqrt(a_var * b_var)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def turns(size: IntArray, axial_radius: int, ramp_rad: FloatArray) -> Float32Array:
    """Cosine and sine of a ramp's phase at the samples of a patch in `buffers`, shape (2, rows * stride)."""
    stride = _stride(size, axial_radius)
    out = np.empty((2, size[0] * stride), np.float32)
    for v in range(size[0]):
        # From the row's first sample on by the addition theorem: two operations for each, not two functions.
        cosine, sine = np.cos(ramp_rad[0] * v), np.sin(ramp_rad[0] * v)
        step_cosine, step_sine = np.cos(ramp_rad[1]), np.sin(ramp_rad[1])
        for k in range(v * stride, (v + 1) * stride):
            out[0, k], out[1, k] = cosine, sine
            turned = cosine * step_cosine - sine * step_sine
            sine = sine * step_cosine + cosine * step_sine
            cosine = turned
    return out


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"}, error_model="numpy")
def _turn(a: Float32Array, ai: Float32Array, cosine: Float32Array, sine: Float32Array, end: int) -> float:
    """Turn a patch's echo back by the ramp's phase, in place; return its power."""
    power: Any = np.float32(0.0)
    for k in range(np.uint64(end)):
        real, imaginary = a[k], ai[k]
        power += real * real + imaginary * imaginary
        a[k] = real * cosine[k] + imaginary * sine[k]
        ai[k] = imaginary * cosine[k] - real * sine[k]
    return float(power)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
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
    """Fill ``out[i, j]`` with the squared coherence of one patch at lag ``shift + (i, j) - radius``.

    Parameters
    ----------
    fixed, moving : float32, shape (2, vector, sample)
        Real and imaginary parts of the echo.
    turn : float32
        From `turns`: what the ramp of `moving` is undone by.
    first, size, shift, least_overlap, corners, room, out
        As for `correlate_patch`.
    """
    lateral, axial = out.shape[0] // 2, out.shape[1] // 2
    v0, v1 = _common(first[0], size[0], fixed.shape[1], lateral, shift[0])
    s0, s1 = _common(first[1], size[1], fixed.shape[2], axial, shift[1])
    rows, width, stride = v1 - v0, s1 - s0, room[0].shape[1] // size[0]
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = np.nan
    if rows <= 0 or width <= 0 or rows * width < least_overlap * size[0] * size[1]:
        return
    end, chunk, powers = rows * stride, _TOGETHER * stride, room[3]
    a, ai, b, bi = room[0][0], room[0][1], room[1][0], room[1][1]
    corner = v0 + shift[0] - lateral, s0 + shift[1] - axial
    _copy(fixed[0], (v0, s0), rows, width, stride, a)
    _copy(fixed[1], (v0, s0), rows, width, stride, ai)
    _copy(moving[0], corner, rows + 2 * lateral, width + 2 * axial, stride, b)
    _copy(moving[1], corner, rows + 2 * lateral, width + 2 * axial, stride, bi)
    _powers(b, bi, rows + 2 * lateral, stride, width, powers)
    power = _turn(a, ai, turn[0], turn[1], end)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            if not corners and i != lateral and j != axial:
                continue
            in_phase, quadrature = _echo_product(a, ai, b, bi, i * stride + j, end, chunk)
            other = 0.0
            for v in range(i, i + rows):
                other += powers[v, j]
            if power * other > 0.0:
                out[i, j] = (in_phase**2 + quadrature**2) / (power * other)
