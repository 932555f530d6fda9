"""Robust linear least squares, and how residuals are correlated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.leastsquares import huber_weights, robust_sigma

_ROUNDING = 1e-9
"""Standard deviation below which the residuals of robust fits are rounding errors."""


def cauchy_weights(residuals: FloatArray, limit: float = 2.385) -> FloatArray:
    """Cauchy's weights: a half at `limit`; the pull of residuals far beyond it vanishes.

    Parameters
    ----------
    residuals : ndarray
        Over their standard deviation.
    """
    return np.asarray(1.0 / (1.0 + (residuals / limit) ** 2))


@dataclass(frozen=True)
class RobustFit:
    """The answer of a linear problem some of whose equations may be wrong.

    Attributes
    ----------
    parameters : ndarray, shape (p,)
    residuals : ndarray, shape (n,) or (n, r)
        ``matrix @ parameters - wanted``.
    rank : int
        Of the weighted matrix.
    """

    parameters: FloatArray
    residuals: FloatArray
    rank: int


def robust_linear(
    matrix: FloatArray,
    wanted: FloatArray,
    weights: Callable[[FloatArray], FloatArray] = huber_weights,
    rounds: int = 5,
    rcond: float | None = None,
) -> RobustFit:
    """Solve linear equations, some of which may be wrong, by iteratively reweighted least squares.

    Parameters
    ----------
    matrix : ndarray, shape (n, p) or (n, r, p)
        A group of r rows gets one weight, from the norm of its residuals. Where equations differ in
        precision, both sides of each are to be divided by its standard deviation.
    wanted : ndarray, shape (n,) or (n, r)
    weights : callable
        Weights of residuals over their robust standard deviation: `huber_weights` or `cauchy_weights`.
    rounds : int
        Number of solutions; the first has equal weights.
    rcond : float, optional
        Ratio of singular values below which a direction counts as not determined; see `numpy.linalg.lstsq`.

    References
    ----------
    .. [1] P. W. Holland and R. E. Welsch, "Robust regression using iteratively reweighted least-squares",
       Commun. Stat. Theory Methods, 1977.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.arange(6.0)
    >>> y = 2.0 * x + np.array([0.0, 0.1, -0.1, 0.0, 50.0, 0.1])
    >>> fit = robust_linear(x[:, None], y, cauchy_weights)
    >>> round(float(fit.parameters[0]), 1)
    2.0
    """
    rows, values = matrix.reshape(-1, matrix.shape[-1]), wanted.ravel()
    group = values.size // len(wanted)
    weight = np.ones(len(wanted))
    for left in range(rounds, 0, -1):
        root = np.repeat(np.sqrt(weight), group)
        found, _, rank, _ = np.linalg.lstsq(rows * root[:, None], values * root, rcond=rcond)
        residuals = rows @ found - values
        if left > 1:
            size = np.linalg.norm(residuals.reshape(-1, group), axis=1)
            weight = weights(size / robust_sigma(size, _ROUNDING))
    return RobustFit(np.asarray(found), residuals.reshape(wanted.shape), int(rank))


def autocorrelation_time(residuals: FloatArray, least_energy: float = 0.0) -> float:
    """How many neighbouring residuals count as one: m / this many of m residuals are independent.

    One plus twice the correlations with neighbours, up to the first lag at which there is none.

    Parameters
    ----------
    residuals : ndarray, shape (m,)
        In order, about zero; NaN where missing.
    least_energy : float
        What their squares are taken to sum to at least.
    """
    there = np.isfinite(residuals)
    count = int(there.sum())
    r = np.where(there, residuals, 0.0)
    energy, time = max(float(r @ r), least_energy), 1.0
    for lag in range(1, count // 4):
        pairs = max(1, int(np.count_nonzero(there[lag:] & there[:-lag])))
        rho = float(r[lag:] @ r[:-lag]) / energy * (count - lag) / pairs if energy > 0 else 0.0
        if rho <= 0:
            break
        time += 2.0 * rho
    return time
