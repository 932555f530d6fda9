"""Least squares with a sensor's wandering error: a Kalman filter over a recording, many sizes at once."""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray

LANES = 32
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
    wide, lanes = columns.shape[1], kept.shape[2]
    rows = 1
    for frame in range(starts.shape[0] - 1):
        rows = max(rows, starts[frame + 1] - starts[frame])
    variance = np.empty((COMPONENTS, COMPONENTS, lanes))
    expected = np.empty((COMPONENTS, wide, lanes))
    white = np.empty((rows, wide, lanes))
    gain = np.empty((rows, COMPONENTS, lanes))
    root = np.empty((rows, rows, lanes))
    product = np.empty(lanes)
    for block in range(first, stop):
        variance[:] = 0.0
        expected[:] = 0.0
        normal[block] = 0.0
        log_determinant[block] = 0.0
        product[:] = 1.0
        for i in range(COMPONENTS):
            for lane in range(lanes):
                variance[i, i, lane] = stationary[block, i, lane]
        for frame in range(starts.shape[0] - 1):
            start = starts[frame]
            _predict(variance, expected, kept[block, frame], stationary[block])
            n = starts[frame + 1] - start
            _decompose(effects[start : start + n], variance, shaken[block], root, gain, product)
            _whiten(columns[start : start + n], effects[start : start + n], expected, root, white)
            _correct(n, white, gain, expected, variance, normal[block])
            for lane in range(lanes):
                if product[lane] > _LARGE:
                    log_determinant[block, lane] += math.log(product[lane])
                    product[lane] = 1.0
        for lane in range(lanes):
            log_determinant[block, lane] += math.log(product[lane])
        for c in range(wide):
            for d in range(c):
                for lane in range(lanes):
                    normal[block, d, c, lane] = normal[block, c, d, lane]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _predict(variance: FloatArray, expected: FloatArray, kept: FloatArray, stationary: FloatArray) -> None:
    """Let the error wander from one frame to the next."""
    lanes = kept.shape[0]
    for i in range(COMPONENTS):
        for j in range(COMPONENTS):
            for lane in range(lanes):
                variance[i, j, lane] *= kept[lane] * kept[lane]
        for lane in range(lanes):
            variance[i, i, lane] += (1.0 - kept[lane] * kept[lane]) * stationary[i, lane]
        for c in range(expected.shape[1]):
            for lane in range(lanes):
                expected[i, c, lane] *= kept[lane]


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
    lanes = product.shape[0]
    for a in range(effects.shape[0]):
        e0, e1, e2, e3, e4, e5 = effects[a]
        for i in range(COMPONENTS):
            for lane in range(lanes):
                gain[a, i, lane] = (
                    e0 * variance[0, i, lane]
                    + e1 * variance[1, i, lane]
                    + e2 * variance[2, i, lane]
                    + e3 * variance[3, i, lane]
                    + e4 * variance[4, i, lane]
                    + e5 * variance[5, i, lane]
                )
        for b in range(a + 1):
            f0, f1, f2, f3, f4, f5 = effects[b]
            own = 1.0 if a == b else 0.0
            for lane in range(lanes):
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
                for lane in range(lanes):
                    root[a, b, lane] -= root[a, k, lane] * root[b, k, lane]
            for lane in range(lanes):
                root[a, b, lane] *= root[b, b, lane]  # whose inverse is kept
                root[a, a, lane] -= root[a, b, lane] * root[a, b, lane]
        for lane in range(lanes):
            product[lane] *= root[a, a, lane]
            root[a, a, lane] = 1.0 / math.sqrt(root[a, a, lane])
        for i in range(COMPONENTS):
            for b in range(a):
                for lane in range(lanes):
                    gain[a, i, lane] -= root[a, b, lane] * gain[b, i, lane]
            for lane in range(lanes):
                gain[a, i, lane] *= root[a, a, lane]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _whiten(
    columns: FloatArray, effects: FloatArray, expected: FloatArray, root: FloatArray, white: FloatArray
) -> None:
    """The root's inverse times what the columns have beyond what was expected."""
    lanes = white.shape[2]
    for a in range(columns.shape[0]):
        e0, e1, e2, e3, e4, e5 = effects[a]
        for c in range(columns.shape[1]):
            value = columns[a, c]
            for lane in range(lanes):
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
                for lane in range(lanes):
                    white[a, c, lane] -= root[a, b, lane] * white[b, c, lane]
            for lane in range(lanes):
                white[a, c, lane] *= root[a, a, lane]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def _correct(
    n: int,
    white: FloatArray,
    gain: FloatArray,
    expected: FloatArray,
    variance: FloatArray,
    normal: FloatArray,
) -> None:
    """Correct the error by `n` whitened rows, and add their products to those so far."""
    wide, lanes = expected.shape[1], white.shape[2]
    for a in range(n):
        for i in range(COMPONENTS):
            for c in range(wide):
                for lane in range(lanes):
                    expected[i, c, lane] += gain[a, i, lane] * white[a, c, lane]
            for j in range(COMPONENTS):
                for lane in range(lanes):
                    variance[i, j, lane] -= gain[a, i, lane] * gain[a, j, lane]
        for c in range(wide):
            for d in range(c + 1):
                for lane in range(lanes):
                    normal[c, d, lane] += white[a, c, lane] * white[a, d, lane]


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
