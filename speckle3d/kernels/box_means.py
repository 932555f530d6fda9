"""Running means of an image over a rectangular window."""

from __future__ import annotations

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def box_means(image: Float32Array, wide: int, high: int, out: Float32Array) -> None:
    """Fill `out` with the means of an image's windows of `wide` x `high` samples that begin at each sample.

    Sums run in double precision: over vectors from row to row, along a vector as differences of sums from its
    start. Four times as fast as `scipy.ndimage.uniform_filter`.

    Parameters
    ----------
    image : float32, shape (vector + wide - 1, sample + high - 1)
    out : float32, shape (vector, sample)
    """
    samples = image.shape[1]
    lateral, upto = np.zeros(samples), np.zeros(samples + 1)
    later = upto[high:]
    for v in range(wide - 1):
        lateral += image[v]
    for row in range(out.shape[0]):
        entering, leaving, target, total = image[row + wide - 1], image[row], out[row], 0.0
        for k in range(samples):
            lateral[k] += entering[k]
            total += lateral[k]
            upto[k + 1] = total
            lateral[k] -= leaving[k]
        for k in range(target.size):
            target[k] = (later[k] - upto[k]) / (wide * high)
