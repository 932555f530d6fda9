"""Least squares: nonlinear with standard errors, linear and robust; how residuals are correlated.

`levenberg_marquardt` solves the chains of calibrations with a phantom and the curves of the drift correction.
Other nonlinear fits need no standard errors and call SciPy themselves. `robust_linear` serves whatever is
linear and has outliers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares, leastsq

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError

Residuals = Callable[[FloatArray], FloatArray]

_MOST_EVALUATIONS = 200

_CONVERGED = (1, 2, 3, 4)
"""What MINPACK returns if it stopped because of a tolerance."""

_ROUNDING = 1e-9
"""Standard deviation below which the residuals of robust fits are rounding errors."""

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class Fit:
    """The answer of a least-squares problem and how well the data determine it.

    Attributes
    ----------
    parameters : ndarray, shape (n,)
    names : tuple of str, length n
    residuals : ndarray, shape (m,)
        At the solution, as given by the caller (weighted if the caller weighted).
    jacobian : ndarray, shape (m, n)
        At the solution.
    """

    parameters: FloatArray
    names: tuple[str, ...]
    residuals: FloatArray
    jacobian: FloatArray
    evaluations: int
    converged: bool

    @cached_property
    def covariance(self) -> FloatArray:
        """Of the parameters, shape (n, n), from the Jacobian at the solution and the residual variance.

        Directions the data do not determine have infinite variance on every parameter they touch.
        """
        return _covariance(self.jacobian, self.residuals)

    @cached_property
    def condition_number(self) -> float:
        """Of the Jacobian (`condition_number`)."""
        return condition_number(self.jacobian)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def standard_errors(self) -> FloatArray:
        """Square roots of the covariance's diagonal, shape (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def levenberg_marquardt(
    residuals: Residuals,
    start: FloatArray,
    jacobian: Residuals | None = None,
    names: Sequence[str] = (),
    tolerance: float = 1e-10,
) -> Fit:
    """Minimise the sum of squared residuals by SciPy's MINPACK, its columns scaled by the Jacobian's.

    Parameters
    ----------
    residuals : callable, (n,) -> (m,)
    start : ndarray, shape (n,)
    jacobian : callable, (n,) -> (m, n), optional
        Without it, finite differences.
    names : sequence of str, length n, optional
    tolerance : float
        Relative change of cost and of scaled parameters at which to stop.

    Raises
    ------
    InvalidInputError
        If there are fewer residuals than parameters, or the residuals at `start` are not finite.

    References
    ----------
    .. [1] J. J. More, "The Levenberg-Marquardt algorithm: implementation and theory", 1977.
    .. [2] Prager et al., CUED/F-INFENG/TR 303, 1997, section 4 (column scaling, condition number).
    """
    x0 = np.asarray(start, dtype=float)
    r0 = residuals(x0)
    if r0.size < x0.size:
        raise InvalidInputError(f"expected at least {x0.size} residuals, got {r0.size}")
    if not np.isfinite(r0).all():
        raise InvalidInputError("expected finite residuals at the starting point, got some that are not")
    labels = tuple(names) if names else tuple(f"p{i}" for i in range(x0.size))
    if jacobian is not None:
        # As `least_squares` with method "lm", which calls the same MINPACK three times as slowly.
        x, _, info, _, status = leastsq(
            residuals,
            x0,
            Dfun=jacobian,
            full_output=True,
            ftol=tolerance,
            xtol=tolerance,
            gtol=tolerance,
            maxfev=_MOST_EVALUATIONS,
        )
        values, evaluations, converged = info["fvec"], info["nfev"], status in _CONVERGED
        slopes = jacobian(x)
    else:
        found = least_squares(
            residuals,
            x0,
            method="lm",
            x_scale="jac",
            xtol=tolerance,
            ftol=tolerance,
            gtol=tolerance,
            max_nfev=_MOST_EVALUATIONS,
        )
        x, values, slopes = found.x, found.fun, np.asarray(found.jac)
        evaluations, converged = found.nfev, found.success
    return Fit(
        parameters=np.asarray(x),
        names=labels,
        residuals=np.asarray(values),
        jacobian=np.array(slopes, dtype=float),
        evaluations=int(evaluations),
        converged=bool(converged),
    )


def condition_number(jacobian: FloatArray) -> float:
    """Ratio of the extreme singular values, columns scaled to unit norm; inf if singular.

    Parameters
    ----------
    jacobian : ndarray, shape (m, n)

    References
    ----------
    .. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, section 4.2.
    """
    singular = np.linalg.svd(jacobian / _column_norms(jacobian), compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")


def robust_sigma(residuals: FloatArray | Float32Array, smallest: float = 0.0) -> float:
    """Standard deviation of normal residuals with the same median size, at least `smallest`."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(residuals))), smallest)


def huber_weights(residuals: FloatArray, limit: float = 1.345) -> FloatArray:
    """Huber's weights: one up to `limit`, beyond it its inverse; with a small limit, least absolute values.

    Parameters
    ----------
    residuals : ndarray
        Over their standard deviation.
    """
    return np.asarray(limit / np.maximum(np.abs(residuals), limit))


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
    weights : ndarray, shape (n,)
        With which the parameters were found.
    rank : int
        Of the weighted matrix.
    """

    parameters: FloatArray
    residuals: FloatArray
    weights: FloatArray
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
    return RobustFit(np.asarray(found), residuals.reshape(wanted.shape), weight, int(rank))


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


def _column_norms(jacobian: FloatArray) -> FloatArray:
    norms = np.linalg.norm(jacobian, axis=0)
    return np.asarray(np.where(norms > 0, norms, 1.0))


def _covariance(jacobian: FloatArray, residuals: FloatArray) -> FloatArray:
    """Covariance of the parameters, infinite where the data do not determine them."""
    scale = _column_norms(jacobian)
    _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    known = singular > singular[0] * max(jacobian.shape) * np.finfo(float).eps
    variance = float(residuals @ residuals) / max(residuals.size - scale.size, 1)
    inverse = (vt[known].T / singular[known] ** 2) @ vt[known]
    covariance = np.asarray(variance * inverse / np.outer(scale, scale))
    blind = (np.abs(vt[~known]) > 1e-6).any(axis=0)
    covariance[np.ix_(blind, blind)] = np.inf
    return covariance
