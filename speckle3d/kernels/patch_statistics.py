"""What tells speckle in the patches of a frame's intensity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray

_FAST = {"reassoc", "contract", "arcp"}


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _pearson(a: Float32Array, vectors: int, samples: int) -> float:
    """Correlation of as many vectors and samples at the beginning of a patch with those at its end."""
    x: Any = np.float32(0.0)
    y = xx = yy = xy = x
    for v in range(vectors):
        first, last = a[v, :samples], a[a.shape[0] - vectors + v, a.shape[1] - samples :]
        for k in range(first.size):
            x, y, xy = x + first[k], y + last[k], xy + first[k] * last[k]
            xx, yy = xx + first[k] * first[k], yy + last[k] * last[k]
    n = vectors * samples
    return float((xy - x * y / n) / np.sqrt((xx - x * x / n) * (yy - y * y / n)))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def patch_statistics(
    image: Float32Array, first: IntArray, size: IntArray, step: int, out: FloatArray
) -> None:
    """Fill ``out[p]`` with the mean, the contrast and three correlations of each `step`-th sample of a patch.

    Parameters
    ----------
    image : float32, shape (vector, sample)
        Intensity.
    first : int64, shape (p, 2)
        First vector and sample of each patch.
    size : int64, shape (2,)
    out : float64, shape (p, 5)
        Mean; standard deviation over mean; coefficients of each vector with the next, of the first half of
        the vectors with the last, and of the first half of the samples with the last. NaN where flat.
    """
    wide, high = size
    samples = (high - 1) // step + 1
    patch = np.empty((wide, samples), np.float32)
    for p in range(len(first)):
        v, s = first[p]
        # A slice that is assigned to compiles for seconds, for numba's words about its shape.
        for a in range(wide):
            for b in range(samples):
                patch[a, b] = image[v + a, s + b * step]
        mean = patch.mean()
        patch /= np.float32(mean)
        patch -= np.float32(1.0)
        out[p, 0], out[p, 1] = mean, np.sqrt((patch * patch).mean())
        out[p, 2] = _pearson(patch, wide - 1, samples)
        out[p, 3], out[p, 4] = _pearson(patch, wide // 2, samples), _pearson(patch, wide, samples // 2)
