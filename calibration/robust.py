"""Linear equations some of which are wrong, and how residuals are correlated."""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import FloatArray

_SOLUTIONS = 4
_NEARLY, _TINY = 0.1, 1e-12
"""Residuals above this share of the median count by their absolute value."""


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
    return np.asarray(1.0 / np.maximum(sizes, _NEARLY * np.median(sizes, axis, keepdims=True) + _TINY))


def autocorrelation_time(residuals: FloatArray) -> float:
    """How many neighbouring residuals count as one: m / this many of m residuals are independent.

    One plus twice the correlations with neighbours, up to the first lag at which there is none.

    Parameters
    ----------
    residuals : ndarray, shape (m,)
        In order, about zero.
    """
    energy, time = max(float(residuals @ residuals), np.finfo(float).tiny), 1.0
    for lag in range(1, len(residuals) // 4):
        rho = float(residuals[lag:] @ residuals[:-lag]) / energy
        if rho <= 0:
            break
        time += 2.0 * rho
    return time
