"""Least squares with a sensor's wandering error: a Kalman filter over a recording, many sizes at once."""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray

LANES = 56
"""Points of the grid that pass through the recording together."""

COMPONENTS = 6
"""Components of the sensor's error; those of a sensor with fewer are zero."""

_LARGE = 1e150
"""Product of variances from which its logarithm is taken; each factor is at least one."""

_SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def innovations(
    columns: FloatArray,
    effects: FloatArray,
    starts: IntArray,
    kept: FloatArray,
    stationary: FloatArray,
    shaken: FloatArray,
    first: int,
    stop: int,
    normal: FloatArray,
    log_determinant: FloatArray,
) -> None:
    """Whiten columns by the errors' covariance and multiply them with each other.

    Parameters
    ----------
    columns : ndarray, shape (m, c)
    effects : ndarray, shape (m, 6)
        How each row moves with the components of the error.
    starts : ndarray of int, shape (frames + 1,)
        First row of each frame, and the number of rows.
    kept : ndarray, shape (blocks, frames, LANES)
        Share of the wandering error that is left over from the frame before, for each point of the grid.
    stationary, shaken : ndarray, shape (blocks, 6, LANES)
        Variance of the components that wander, and of those that are new in every frame.
    first, stop : int
        Blocks of the grid to be done.
    normal : ndarray, shape (blocks, c, c, LANES)
        Filled: products of the innovations.
    log_determinant : ndarray, shape (blocks, LANES)
        Filled.
    """
    wide, frames = columns.shape[1], starts.shape[0] - 1
    rows = 1
    for frame in range(frames):
        rows = max(rows, starts[frame + 1] - starts[frame])
    variance = np.empty((COMPONENTS, COMPONENTS, LANES))
    expected = np.empty((COMPONENTS, wide, LANES))
    white = np.empty((rows + 1, wide, LANES))
    gain = np.empty((rows + 1, COMPONENTS, LANES))
    root = np.empty((rows, rows, LANES))
    product, all_kept = np.empty(LANES), np.ones(LANES)
    for block in range(first, stop):
        # Before the first frame the error is as it is at any time.
        variance[:] = 0.0
        for i in range(COMPONENTS):
            for lane in range(LANES):
                variance[i, i, lane] = stationary[block, i, lane]
        expected[:] = 0.0
        normal[block] = 0.0
        log_determinant[block] = 0.0
        product[:] = 1.0
        for frame in range(frames):
            start = starts[frame]
            n = starts[frame + 1] - start
            _decompose(effects[start : start + n], variance, shaken[block], root, gain, product)
            _whiten(columns[start : start + n], effects[start : start + n], expected, root, white)
            # Rows are used two at a time, for time: a last one without a partner gets one of zeros.
            gain[n] = 0.0
            white[n] = 0.0
            for a in range(0, n, 2):
                last = a + 2 >= n and frame + 1 < frames
                left = kept[block, frame + 1] if last else all_kept
                _correct(white[a : a + 2], gain[a : a + 2], left, stationary[block], expected, variance)
                _multiply(white[a : a + 2], normal[block])
            for lane in range(LANES):
                if product[lane] > _LARGE:
                    log_determinant[block, lane] += math.log(product[lane])
                    product[lane] = 1.0
        for lane in range(LANES):
            log_determinant[block, lane] += math.log(product[lane])
        for c in range(wide):
            for d in range(c):
                for lane in range(LANES):
                    normal[block, d, c, lane] = normal[block, c, d, lane]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _decompose(
    effects: FloatArray,
    variance: FloatArray,
    shaken: FloatArray,
    root: FloatArray,
    gain: FloatArray,
    product: FloatArray,
) -> None:
    """Root of the rows' covariance (Cholesky), its determinant, and its inverse times the rows' gain."""
    for a in range(effects.shape[0]):
        e0, e1, e2, e3, e4, e5 = effects[a]
        for i in range(COMPONENTS):
            for lane in range(LANES):
                gain[a, i, lane] = (
                    e0 * variance[max(i, 0), min(i, 0), lane]
                    + e1 * variance[max(i, 1), min(i, 1), lane]
                    + e2 * variance[max(i, 2), min(i, 2), lane]
                    + e3 * variance[max(i, 3), min(i, 3), lane]
                    + e4 * variance[max(i, 4), min(i, 4), lane]
                    + e5 * variance[max(i, 5), min(i, 5), lane]
                )
        for b in range(a + 1):
            f0, f1, f2, f3, f4, f5 = effects[b]
            own = 1.0 if a == b else 0.0
            for lane in range(LANES):
                root[a, b, lane] = (
                    own
                    + f0 * (gain[a, 0, lane] + e0 * shaken[0, lane])
                    + f1 * (gain[a, 1, lane] + e1 * shaken[1, lane])
                    + f2 * (gain[a, 2, lane] + e2 * shaken[2, lane])
                    + f3 * (gain[a, 3, lane] + e3 * shaken[3, lane])
                    + f4 * (gain[a, 4, lane] + e4 * shaken[4, lane])
                    + f5 * (gain[a, 5, lane] + e5 * shaken[5, lane])
                )
    for a in range(effects.shape[0]):
        for b in range(a):
            for k in range(b):
                for lane in range(LANES):
                    root[a, b, lane] -= root[a, k, lane] * root[b, k, lane]
            for lane in range(LANES):
                root[a, b, lane] *= root[b, b, lane]  # whose inverse is kept
                root[a, a, lane] -= root[a, b, lane] * root[a, b, lane]
        for lane in range(LANES):
            product[lane] *= root[a, a, lane]
            root[a, a, lane] = 1.0 / math.sqrt(root[a, a, lane])
        for i in range(COMPONENTS):
            for b in range(a):
                for lane in range(LANES):
                    gain[a, i, lane] -= root[a, b, lane] * gain[b, i, lane]
            for lane in range(LANES):
                gain[a, i, lane] *= root[a, a, lane]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _whiten(
    columns: FloatArray, effects: FloatArray, expected: FloatArray, root: FloatArray, white: FloatArray
) -> None:
    """The root's inverse times what the columns have beyond what was expected."""
    for a in range(columns.shape[0]):
        e0, e1, e2, e3, e4, e5 = effects[a]
        for c in range(columns.shape[1]):
            value = columns[a, c]
            for lane in range(LANES):
                white[a, c, lane] = (
                    value
                    - e0 * expected[0, c, lane]
                    - e1 * expected[1, c, lane]
                    - e2 * expected[2, c, lane]
                    - e3 * expected[3, c, lane]
                    - e4 * expected[4, c, lane]
                    - e5 * expected[5, c, lane]
                )
            for b in range(a):
                for lane in range(LANES):
                    white[a, c, lane] -= root[a, b, lane] * white[b, c, lane]
            for lane in range(LANES):
                white[a, c, lane] *= root[a, a, lane]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _correct(
    white: FloatArray,
    gain: FloatArray,
    kept: FloatArray,
    stationary: FloatArray,
    expected: FloatArray,
    variance: FloatArray,
) -> None:
    """Correct the error by two whitened rows, and let it wander until only a share of it is left."""
    for i in range(COMPONENTS):
        for c in range(expected.shape[1]):
            for lane in range(LANES):
                expected[i, c, lane] = kept[lane] * (
                    expected[i, c, lane]
                    + gain[0, i, lane] * white[0, c, lane]
                    + gain[1, i, lane] * white[1, c, lane]
                )
        for j in range(i + 1):
            for lane in range(LANES):
                variance[i, j, lane] = (kept[lane] * kept[lane]) * (
                    variance[i, j, lane]
                    - gain[0, i, lane] * gain[0, j, lane]
                    - gain[1, i, lane] * gain[1, j, lane]
                )
        for lane in range(LANES):
            variance[i, i, lane] += (1.0 - kept[lane] * kept[lane]) * stationary[i, lane]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _multiply(white: FloatArray, normal: FloatArray) -> None:
    """Add the products of the columns of two whitened rows to those so far, below the diagonal."""
    for c in range(white.shape[1]):
        for d in range(c + 1):
            for lane in range(LANES):
                normal[c, d, lane] += (
                    white[0, c, lane] * white[0, d, lane] + white[1, c, lane] * white[1, d, lane]
                )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def attribute(
    residuals: FloatArray,
    effects: FloatArray,
    starts: IntArray,
    spread: FloatArray,
    least: float,
    sensor: FloatArray,
    image: FloatArray,
) -> None:
    """Divide residuals, each frame by itself, between an error that moves the frame and white noise.

    Parameters
    ----------
    residuals : ndarray, shape (m,)
    effects : ndarray, shape (m, k)
        How each residual moves with the components of the frame's error.
    starts : ndarray of int, shape (frames + 1,)
        First row of each frame, and the number of rows.
    spread : ndarray, shape (k,)
        Variances of the components.
    least : float
        Variance of the white noise.
    sensor, image : ndarray, shapes (m, k) and (m,)
        Filled: the expected error of each residual's frame, and noise of each residual.
    """
    components = effects.shape[1]
    rows = 1
    for frame in range(starts.shape[0] - 1):
        rows = max(rows, starts[frame + 1] - starts[frame])
    root, pull = np.empty((rows, rows)), np.empty(rows)
    for frame in range(starts.shape[0] - 1):
        first, n = starts[frame], starts[frame + 1] - starts[frame]
        for a in range(n):
            for b in range(a + 1):
                total = least if a == b else 0.0
                for k in range(components):
                    total += effects[first + a, k] * spread[k] * effects[first + b, k]
                for k in range(b):
                    total -= root[a, k] * root[b, k]
                root[a, b] = math.sqrt(total) if a == b else total / root[b, b]
        for a in range(n):
            value = residuals[first + a]
            for b in range(a):
                value -= root[a, b] * pull[b]
            pull[a] = value / root[a, a]
        for a in range(n - 1, -1, -1):
            value = pull[a]
            for b in range(a + 1, n):
                value -= root[b, a] * pull[b]
            pull[a] = value / root[a, a]
        for k in range(components):
            error = 0.0
            for a in range(n):
                error += pull[a] * effects[first + a, k]
            for a in range(n):
                sensor[first + a, k] = spread[k] * error
        for a in range(n):
            image[first + a] = least * pull[a]
