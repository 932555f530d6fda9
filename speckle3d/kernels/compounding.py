"""Averaging image samples into voxels, and filling the voxels that got none."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from speckle3d.core.arrays import Float32Array, FloatArray


@njit(cache=True, nogil=True, fastmath=False)
def add_samples(
    image: Float32Array,
    index_from_sample: FloatArray,
    total: Float32Array,
    count: npt.NDArray[np.uint32],
) -> None:
    """Add every sample of one image to the voxel it lies in.

    Parameters
    ----------
    image : ndarray, shape (vector, sample)
        NaN does not count.
    index_from_sample : ndarray, shape (3, 3)
        From (vector, sample, 1) to fractional voxel indices (i, j, k); voxel centres are whole numbers.
    total, count : ndarray, shape (n_i, n_j, n_k), changed in place
        Sum and number of the samples so far. Samples outside the voxels are left out.
    """
    n_i, n_j, n_k = total.shape
    m = index_from_sample
    for vector in range(image.shape[0]):
        x = m[0, 0] * vector + m[0, 2] + 0.5
        y = m[1, 0] * vector + m[1, 2] + 0.5
        z = m[2, 0] * vector + m[2, 2] + 0.5
        for sample in range(image.shape[1]):
            i = math.floor(x + m[0, 1] * sample)
            j = math.floor(y + m[1, 1] * sample)
            k = math.floor(z + m[2, 1] * sample)
            level = image[vector, sample]
            if 0 <= i < n_i and 0 <= j < n_j and 0 <= k < n_k and not math.isnan(level):
                total[i, j, k] += level
                count[i, j, k] += np.uint32(1)


@njit(cache=True, parallel=True, fastmath=False)
def fill_from_shell(voxels: Float32Array, distance: npt.NDArray[np.int32], cap: int) -> None:
    """Give each empty voxel the mean of the filled ones in the smallest cube around it that holds any.

    Parameters
    ----------
    voxels : ndarray, shape (n_i, n_j, n_k), changed in place
    distance : ndarray, shape (n_i, n_j, n_k)
        Chessboard distance to the nearest filled voxel: 0 where filled, half the smallest cube's edge
        elsewhere.
    cap : int
        Voxels with a larger distance stay as they are.
    """
    for i in prange(voxels.shape[0]):
        for j in range(voxels.shape[1]):
            for k in range(voxels.shape[2]):
                if 0 < distance[i, j, k] <= cap:
                    # Threads read only filled voxels and write only empty ones.
                    voxels[i, j, k] = _mean_of_filled(voxels, distance, i, j, k)


@njit(cache=True, fastmath=False)
def _mean_of_filled(voxels: Float32Array, distance: npt.NDArray[np.int32], i: int, j: int, k: int) -> float:
    r = distance[i, j, k]
    total, count = 0.0, 0
    for a in range(max(i - r, 0), min(i + r + 1, voxels.shape[0])):
        for b in range(max(j - r, 0), min(j + r + 1, voxels.shape[1])):
            # Nothing is filled inside the cube's shell, so only the ends of inner lines are read.
            stride = 1 if abs(a - i) == r or abs(b - j) == r else 2 * r
            for c in range(k - r, k + r + 1, stride):
                if 0 <= c < voxels.shape[2] and distance[a, b, c] == 0:
                    total += voxels[a, b, c]
                    count += 1
    return total / count
