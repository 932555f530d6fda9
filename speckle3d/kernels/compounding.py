"""Filling the voxels that got no sample."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from speckle3d.core.arrays import Float32Array


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
