"""Correlation of matching patches of two images, or of their complex echoes, at neighbouring lags."""

from typing import Any

import numpy as np
from numba.extending import register_jitable

from speckle3d.core.arrays import Float32Array, FloatArray

LAGS = ((-1, 0), (0, -1), (0, 0), (0, 1), (1, 0))
"""Vectors and samples from the lag that is asked for: itself in the middle, and its four neighbours."""
_FLAT = 1e-4
"""Share of a patch's energy that its variance must exceed, beyond what is left of it in float32; speckle's is
a half."""
_FAST = {"reassoc", "contract", "arcp"}

Window = tuple[int, int, int, int]
"""First vector and end, first sample and end."""
Lag = tuple[int, int]
Sums = tuple[float, float, float, float, float]
"""At each of `LAGS`."""


@register_jitable(fastmath=False, error_model="numpy")
def common_window(first: Lag, size: Lag, shape: Lag, lag: Lag, least_overlap: float) -> Window:
    """Part of a patch that stays inside the other image at a lag and its neighbours; empty if too small."""
    v0, v1 = max(first[0], 1 - lag[0]), min(first[0] + size[0], shape[0] - 1 - lag[0])
    s0, s1 = max(first[1], 1 - lag[1]), min(first[1] + size[1], shape[1] - 1 - lag[1])
    if v1 <= v0 or s1 <= s0 or (v1 - v0) * (s1 - s0) < least_overlap * size[0] * size[1]:
        return 0, 0, 0, 0
    return v0, v1, s0, s1


@register_jitable(fastmath=_FAST, error_model="numpy")
def _sums(
    a: Float32Array, b: Float32Array, window: Window, lag: Lag
) -> tuple[float, float, Sums, Sums, Sums]:
    """Sum of a and of its square; sums of a b, of b and of its square at the five lags."""
    v0, v1, s0, s1 = window
    start, end = s0 + lag[1], s1 + lag[1]
    zero: Any = np.float32(0.0)
    total = square = p0 = p1 = p2 = p3 = p4 = t0 = t1 = t2 = t3 = t4 = q0 = q1 = q2 = q3 = q4 = zero
    for v in range(v0, v1):
        w, row = v + lag[0], a[v, s0:s1]
        above, beside, below = b[w - 1, start:end], b[w, start - 1 : end + 1], b[w + 1, start:end]
        for k in range(row.size):
            x, up, left, at, right, down = row[k], above[k], beside[k], beside[k + 1], beside[k + 2], below[k]
            total, square = total + x, square + x * x
            p0, p1, p2, p3, p4 = p0 + x * up, p1 + x * left, p2 + x * at, p3 + x * right, p4 + x * down
            t0, t1, t2, t3, t4 = t0 + up, t1 + left, t2 + at, t3 + right, t4 + down
            q0, q1, q2 = q0 + up * up, q1 + left * left, q2 + at * at
            q3, q4 = q3 + right * right, q4 + down * down
    return total, square, (p0, p1, p2, p3, p4), (t0, t1, t2, t3, t4), (q0, q1, q2, q3, q4)


@register_jitable(fastmath=False, error_model="numpy")
def correlate_patch(
    fixed: Float32Array, moving: Float32Array, window: Window, lag: Lag, out: FloatArray
) -> None:
    """Fill `out`, shape (5,), with Pearson's coefficient at a lag and its neighbours; NaN where flat.

    Parameters
    ----------
    fixed, moving : float32, shape (vector, sample)
    window : tuple of int
        In `fixed`, from `common_window`.
    lag : tuple of int
        Vectors and samples, about which to look in `moving`.
    """
    n = max((window[1] - window[0]) * (window[3] - window[2]), 1)
    a, aa, products, others, squares = _sums(fixed, moving, window, lag)
    a_variance = aa - a * a / n
    for k in range(5):
        variance = squares[k] - others[k] * others[k] / n
        varies = a_variance > _FLAT * aa and variance > _FLAT * squares[k]
        out[k] = (products[k] - a * others[k] / n) / np.sqrt(a_variance * variance) if varies else np.nan


@register_jitable(fastmath=_FAST, error_model="numpy")
def _added(
    x: float, y: float, re: float, im: float, real: float, imaginary: float, power: float
) -> tuple[float, float, float]:
    """Sums of conj(x + iy) (re + i im) and of its second factor's power, with one more sample."""
    return real + x * re + y * im, imaginary + x * im - y * re, power + re * re + im * im


@register_jitable(fastmath=_FAST, error_model="numpy")
def _echo_sums(
    a: Float32Array, b: Float32Array, turn: Float32Array, window: Window, lag: Lag
) -> tuple[float, Sums, Sums, Sums]:
    """Sum of a's power; real and imaginary sums of conj(a) b, a turned back, and of b's power at the lags."""
    # Unsigned indices are not tested for being negative.
    one, begin, start = np.uint64(1), np.uint64(window[2]), np.uint64(window[2] + lag[1])
    zero: Any = np.float32(0.0)
    own = r0 = r1 = r2 = r3 = r4 = i0 = i1 = i2 = i3 = i4 = p0 = p1 = p2 = p3 = p4 = zero
    for row in range(np.uint64(window[1] - window[0])):
        v, w = row + np.uint64(window[0]), row + np.uint64(window[0] + lag[0])
        for k in range(np.uint64(window[3] - window[2])):
            i, j = begin + k, start + k
            real, imaginary, cosine, sine = a[0, v, i], a[1, v, i], turn[0, row, k], turn[1, row, k]
            x, y = real * cosine + imaginary * sine, imaginary * cosine - real * sine
            own += x * x + y * y
            r0, i0, p0 = _added(x, y, b[0, w - one, j], b[1, w - one, j], r0, i0, p0)
            r1, i1, p1 = _added(x, y, b[0, w, j - one], b[1, w, j - one], r1, i1, p1)
            r2, i2, p2 = _added(x, y, b[0, w, j], b[1, w, j], r2, i2, p2)
            r3, i3, p3 = _added(x, y, b[0, w, j + one], b[1, w, j + one], r3, i3, p3)
            r4, i4, p4 = _added(x, y, b[0, w + one, j], b[1, w + one, j], r4, i4, p4)
    return own, (r0, r1, r2, r3, r4), (i0, i1, i2, i3, i4), (p0, p1, p2, p3, p4)


@register_jitable(fastmath=False, error_model="numpy")
def cohere_patch(
    fixed: Float32Array, moving: Float32Array, turn: Float32Array, window: Window, lag: Lag, out: FloatArray
) -> None:
    """Fill `out`, shape (5,), with the squared coherence at a lag and its neighbours; NaN where empty.

    Parameters
    ----------
    fixed, moving : float32, shape (2, vector, sample)
        Real and imaginary parts of the echo.
    turn : float32, shape (2, v, s)
        From `phase_ramp`: what the ramp of `moving` is undone by.
    window, lag
        As for `correlate_patch`.
    """
    own, real, imaginary, power = _echo_sums(fixed, moving, turn, window, lag)
    for k in range(5):
        both = own * power[k]
        out[k] = (real[k] ** 2 + imaginary[k] ** 2) / both if both > 0.0 else np.nan


@register_jitable(fastmath=False, error_model="numpy")
def phase_ramp(size: Lag, lateral_rad: float, axial_rad: float) -> Float32Array:
    """Cosine and sine of a phase that rises by so much per vector and sample of a patch, shape (2, v, s)."""
    along, out = np.empty((2, size[1])), np.empty((2, size[0], size[1]), np.float32)
    for s in range(size[1]):
        along[0, s], along[1, s] = np.cos(axial_rad * s), np.sin(axial_rad * s)
    for v in range(size[0]):
        cosine, sine = np.cos(lateral_rad * v), np.sin(lateral_rad * v)
        for s in range(size[1]):
            out[0, v, s] = cosine * along[0, s] - sine * along[1, s]
            out[1, v, s] = cosine * along[1, s] + sine * along[0, s]
    return out
