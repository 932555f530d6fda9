"""Whiten residuals for sensor errors correlated in time, by a Kalman filter."""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})
def innovations(
    columns: FloatArray,
    effects: FloatArray,
    starts: IntArray,
    kept: FloatArray,
    stationary: FloatArray,
    shaken: FloatArray,
    white: FloatArray,
) -> float:
    """Whiten columns by the covariance of a sensor's error.

    Parameters
    ----------
    columns : ndarray, shape (m, c)
    effects : ndarray, shape (m, k)
        How each row moves with the components of the error.
    starts : ndarray of int, shape (frames + 1,)
        First row of each frame, and the number of rows.
    kept : ndarray, shape (frames,)
        Share of the wandering error that is left over from the frame before.
    stationary, shaken : ndarray, shape (k,)
        Variances of the components that wander, and of those that are new in every frame; the rows' own white
        noise has a variance of one.
    white : ndarray, shape (m, c)
        Filled: the innovations.

    Returns
    -------
    float
        Logarithm of the determinant of the rows' covariance.
    """
    wide, size, rows = columns.shape[1], effects.shape[1], 1
    for frame in range(starts.shape[0] - 1):
        rows = max(rows, starts[frame + 1] - starts[frame])
    variance, expected = np.zeros((size, size)), np.zeros((size, wide))
    gain, root = np.empty((rows, size)), np.empty((rows, rows))
    log_determinant = 0.0
    for i in range(size):
        variance[i, i] = stationary[i]
    for frame in range(starts.shape[0] - 1):
        first, n, left = starts[frame], starts[frame + 1] - starts[frame], kept[frame]
        for i in range(size):
            for j in range(size):
                variance[i, j] *= left * left
            variance[i, i] += (1.0 - left * left) * stationary[i]
            for c in range(wide):
                expected[i, c] *= left
        for a in range(n):
            for i in range(size):
                total = 0.0
                for j in range(size):
                    total += effects[first + a, j] * variance[j, i]
                gain[a, i] = total
            for b in range(a + 1):
                total = 1.0 if a == b else 0.0
                for i in range(size):
                    total += effects[first + b, i] * (gain[a, i] + effects[first + a, i] * shaken[i])
                for q in range(b):
                    total -= root[a, q] * root[b, q]
                # The diagonal's reciprocals, by which rows are multiplied.
                root[a, b] = 1.0 / math.sqrt(total) if a == b else total * root[b, b]
            log_determinant += math.log(total)
        for a in range(n):
            for i in range(size):
                for b in range(a):
                    gain[a, i] -= root[a, b] * gain[b, i]
                gain[a, i] *= root[a, a]
            # Columns innermost, which the compiler takes several at a time.
            for c in range(wide):
                white[first + a, c] = columns[first + a, c]
            for i in range(size):
                for c in range(wide):
                    white[first + a, c] -= effects[first + a, i] * expected[i, c]
            for b in range(a):
                for c in range(wide):
                    white[first + a, c] -= root[a, b] * white[first + b, c]
            for c in range(wide):
                white[first + a, c] *= root[a, a]
        for a in range(n):
            for i in range(size):
                for c in range(wide):
                    expected[i, c] += gain[a, i] * white[first + a, c]
                for j in range(size):
                    variance[i, j] -= gain[a, i] * gain[a, j]
    return log_determinant
