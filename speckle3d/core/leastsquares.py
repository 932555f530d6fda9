"""Scatter of residuals, weights that bound what outliers do, and how well a problem is posed."""

import numpy as np

from speckle3d.core.arrays import Float32Array, FloatArray

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def robust_sigma(residuals: FloatArray | Float32Array, smallest: float = 0.0) -> float:
    """Standard deviation of normal residuals with the same median size, at least `smallest`."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(residuals))), smallest)


def huber_weights(residuals: FloatArray, limit: float = 2.0) -> FloatArray:
    """Huber's weights: one up to `limit`, beyond it its inverse; with a small limit, least absolute values.

    Parameters
    ----------
    residuals : ndarray
        Over their standard deviation.
    """
    return np.asarray(limit / np.maximum(np.abs(residuals), limit))


def condition_number(jacobian: FloatArray) -> float:
    """Ratio of the extreme singular values, columns scaled to unit norm; inf if singular.

    Parameters
    ----------
    jacobian : ndarray, shape (m, n)

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, section 4.2.
    """
    norms = np.linalg.norm(jacobian, axis=0)
    return float(np.linalg.cond(jacobian / np.where(norms > 0, norms, 1.0)))
