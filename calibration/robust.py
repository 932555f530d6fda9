"""Linear equations some of which are wrong, and weights of residuals that count by their absolute value."""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import FloatArray

_SOLUTIONS, _NEARLY = 4, 0.1
"""Rounds of weighting; share of the median above which residuals count by their absolute value."""
_TINY = 1e-12
"""Residuals of exact data."""


def robust_linear(matrix: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solve linear equations, some of which may be wrong, by iteratively reweighted least squares.

    Parameters
    ----------
    matrix : ndarray, shape (n, p) or (n, r, p)
        A group of r rows gets one weight, from the norm of its residuals.
    target : ndarray, shape (n,) or (n, r)

    Returns
    -------
    parameters : ndarray, shape (p,)
        The smallest, where the equations leave some open.
    residuals : ndarray, as `target`

    References
    ----------
    .. [1] P. W. Holland and R. E. Welsch, "Robust regression using iteratively reweighted least-squares",
       Commun. Stat. Theory Methods, 1977.
    """
    rows, values = matrix.reshape(-1, matrix.shape[-1]), target.ravel()
    group = values.size // len(target)
    root = np.ones(values.size)
    for _ in range(_SOLUTIONS):
        parameters = np.linalg.lstsq(rows * root[:, None], values * root)[0]
        residuals = rows @ parameters - values
        size = np.linalg.norm(residuals.reshape(-1, group), axis=1)
        root = np.repeat(np.sqrt(absolute_weights(size)), group)
    return np.asarray(parameters), np.asarray(residuals).reshape(target.shape)


def absolute_weights(sizes: FloatArray, axis: int | None = None) -> FloatArray:
    """Weights by which most residuals count by their absolute value: Huber's, with a tenth of the median."""
    return 1.0 / np.maximum(sizes, _NEARLY * np.median(sizes, axis, keepdims=True) + _TINY)
