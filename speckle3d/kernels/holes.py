"""Filling empty voxels from measured ones nearby."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray, IntArray
from speckle3d.core.labels import EMPTY, FILLED, MEASURED

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
    holes = np.empty(n_j, np.int64)
    for k in range(first, stop):
        left = 0
        for j in range(n_j):
            holes[j] = 0
            for i in range(n_i):
                holes[j] += state[k, j, i] == EMPTY
            left += holes[j]
        if left == 0:
            continue
        total[:], count[:] = 0.0, 0
        _add_plane(voxels[k], state[k], total, count)
        summed = 0
        for box in range(boxes.shape[0]):
            while summed < boxes[box, 0]:
                summed += 1
                if k - summed >= 0:
                    _add_plane(voxels[k - summed], state[k - summed], total, count)
                if k + summed < n_k:
                    _add_plane(voxels[k + summed], state[k + summed], total, count)
            half_j, half_i = boxes[box, 1], boxes[box, 2]
            for j in range(n_j):
                if holes[j] == 0:
                    continue
                _sum_rows(total, count, max(j - half_j, 0), min(j + half_j + 1, n_j), row_total, row_count)
                done = _fill_row(voxels[k, j], state[k, j], half_i, row_total, row_count)
                holes[j] -= done
                left -= done
            if left == 0:
                break


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _add_plane(voxels: Float32Array, state: ByteArray, total: FloatArray, count: CountArray) -> None:
    """Add the measured voxels of a plane to the sum and the number so far."""
    for j in range(voxels.shape[0]):
        for i in range(voxels.shape[1]):
            measured = state[j, i] == MEASURED
            total[j, i] += voxels[j, i] if measured else np.float32(0.0)
            count[j, i] += np.uint32(measured)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _sum_rows(
    total: FloatArray, count: CountArray, first: int, stop: int, row_total: FloatArray, row_count: CountArray
) -> None:
    row_total[:], row_count[:] = total[first], count[first]
    for j in range(first + 1, stop):
        for i in range(row_total.shape[0]):
            row_total[i] += total[j, i]
            row_count[i] += count[j, i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _fill_row(
    voxels: Float32Array, state: ByteArray, half: int, row_total: FloatArray, row_count: CountArray
) -> int:
    """Fill the holes of a row that have measured voxels within the box; return how many."""
    n_i = voxels.shape[0]
    done = 0
    for i in range(n_i):
        if state[i] != EMPTY:
            continue
        total, count = 0.0, 0
        for c in range(max(i - half, 0), min(i + half + 1, n_i)):
            total += row_total[c]
            count += row_count[c]
        if count > 0:
            voxels[i] = total / count
            state[i] = FILLED
            done += 1
    return done
