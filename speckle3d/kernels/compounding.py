"""Averaging image samples into voxels."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

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
