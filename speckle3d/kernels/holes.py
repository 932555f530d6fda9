"""Filling empty voxels from measured ones nearby."""

import numpy as np
import numpy.typing as npt
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray, IntArray
from speckle3d.core.volume import EMPTY, FILLED, MEASURED

CountArray = npt.NDArray[np.uint32]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def fill_planes(voxels: Float32Array, state: ByteArray, boxes: IntArray, first: int, stop: int) -> None:
    """Give each empty voxel of some planes the mean of the measured ones in the smallest box that has any.

    A plane is summed along k, then along j, then, where it has holes, along i, so that a box costs the sum of
    its edges and not their product. Sums are of double precision: exact for the few hundred values of a box,
    unless these differ by a factor of millions.

    Parameters
    ----------
    voxels : ndarray, shape (n_k, n_j, n_i), changed in place
    state : ndarray, shape (n_k, n_j, n_i), changed in place
        `EMPTY`, `MEASURED` or `FILLED`; other planes may be changed from empty to filled meanwhile.
    boxes : ndarray, shape (n, 3)
        Half edges (k, j, i) of the boxes to try in turn, each at least as large as the one before.
    first, stop : int
        Planes to fill.
    """
    n_k, n_j, n_i = voxels.shape
    total, count = np.empty((n_j, n_i)), np.empty((n_j, n_i), np.uint32)
    row_total, row_count = np.empty(n_i), np.empty(n_i, np.uint32)
    for k in range(first, stop):
        total[:], count[:] = 0.0, 0
        reach_k, holes = -1, True
        for box in range(boxes.shape[0]):
            if not holes:
                break
            half_k, half_j, half_i = boxes[box]
            while reach_k < half_k:
                reach_k += 1
                for plane in range(k - reach_k, k + reach_k + 1, max(2 * reach_k, 1)):
                    if 0 <= plane < n_k:
                        _add_plane(voxels[plane], state[plane], total, count)
            holes = False
            for j in range(n_j):
                if not (state[k, j] == EMPTY).any():
                    continue
                row_total[:], row_count[:] = 0.0, 0
                for row in range(max(j - half_j, 0), min(j + half_j + 1, n_j)):
                    row_total += total[row]
                    row_count += count[row]
                for i in range(n_i):
                    if state[k, j, i] == EMPTY:
                        level, number = 0.0, 0
                        for cell in range(max(i - half_i, 0), min(i + half_i + 1, n_i)):
                            level += row_total[cell]
                            number += row_count[cell]
                        if number > 0:
                            voxels[k, j, i] = level / number
                            state[k, j, i] = FILLED
                        else:
                            holes = True


@register_jitable(fastmath=False, error_model="numpy")
def _add_plane(voxels: Float32Array, state: ByteArray, total: FloatArray, count: CountArray) -> None:
    """Add the measured voxels of a plane to the sum and the number so far."""
    for j in range(voxels.shape[0]):
        for i in range(voxels.shape[1]):
            is_level = state[j, i] == MEASURED
            total[j, i] += voxels[j, i] if is_level else np.float32(0.0)
            count[j, i] += np.uint32(is_level)
