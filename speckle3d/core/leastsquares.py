"""Levenberg-Marquardt with the diagnosis a published number needs.

One solver for the whole package: SciPy's `least_squares`, the columns of the Jacobian scaled to unit
norm at the start (Prager et al. 1997, section 4), and a `Fit` that says how well the data determine
the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError

Residuals = Callable[[FloatArray], FloatArray]

_MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class Fit:
    """The answer of a least-squares problem and how far it can be trusted.

    Attributes
    ----------
    parameters : ndarray, shape (n,)
    names : tuple of str, length n
    residuals : ndarray, shape (m,)
        At the solution, as given by the caller (weighted if the caller weighted).
    covariance : ndarray, shape (n, n)
        Of the parameters, from the Jacobian at the solution and the residual variance; directions the
        data do not determine have infinite variance on every parameter they touch.
    singular_values : ndarray, shape (n,)
        Of the Jacobian with columns scaled to unit norm, descending.
    weakest_direction : ndarray, shape (n,)
        Right singular vector of the least singular value, in scaled parameters.
    """

    parameters: FloatArray
    names: tuple[str, ...]
    residuals: FloatArray
    covariance: FloatArray
    singular_values: FloatArray
    weakest_direction: FloatArray
    evaluations: int
    converged: bool
    message: str

    @property
    def condition_number(self) -> float:
        """Ratio of the largest and the least singular value of the scaled Jacobian; inf if singular."""
        least = self.singular_values[-1]
        return float(self.singular_values[0] / least) if least > 0 else float("inf")

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def standard_errors(self) -> FloatArray:
        """Square roots of the covariance's diagonal, shape (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def weakest_parameters(self, share: float = 0.3) -> tuple[str, ...]:
        """Names of the parameters that make up the least determined direction, strongest first."""
        order = np.argsort(-np.abs(self.weakest_direction))
        return tuple(self.names[i] for i in order if abs(self.weakest_direction[i]) >= share)


def levenberg_marquardt(
    residuals: Residuals,
    start: FloatArray,
    jacobian: Residuals | None = None,
    names: Sequence[str] = (),
    tolerance: float = 1e-10,
    max_evaluations: int = 200,
) -> Fit:
    """Minimise the sum of squared residuals.

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
    found = least_squares(
        residuals,
        x0,
        jac=jacobian if jacobian is not None else "2-point",
        method="lm",
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=max_evaluations,
    )
    return _diagnose(
        found.x, found.fun, np.asarray(found.jac), labels, found.nfev, found.success, found.message
    )


def robust_sigma(residuals: FloatArray | Float32Array, smallest: float = 0.0) -> float:
    """Standard deviation of normal residuals with the same median size, at least `smallest`."""
    return max(_MAD_TO_SIGMA * float(np.median(np.abs(residuals))), smallest)


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
    """The answer of a linear problem some of whose equations are wrong.

    Attributes
    ----------
    parameters : ndarray, shape (p,)
    residuals : ndarray, shape (n,) or (n, r)
        ``matrix @ parameters - wanted``.
    weights : ndarray, shape (n,)
        With which the parameters were found.
    sigma : float
        Robust standard deviation of the residuals, of their norm where they come in groups.
    rank : int
        Of the weighted matrix.
    normal : ndarray, shape (p, p)
        Normal matrix of the weighted equations.
    """

    parameters: FloatArray
    residuals: FloatArray
    weights: FloatArray
    sigma: float
    rank: int
    normal: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the parameters, shape (p, p); fails where they are not determined."""
        return np.asarray(np.linalg.inv(self.normal) * self.sigma**2)


def robust_linear(
    matrix: FloatArray,
    wanted: FloatArray,
    weights: Callable[[FloatArray], FloatArray] = huber_weights,
    rounds: int = 5,
    rcond: float | None = None,
    smallest_sigma: float = 1e-9,
) -> RobustFit:
    """Solve linear equations by iteratively reweighted least squares.

    Parameters
    ----------
    matrix : ndarray, shape (n, p) or (n, r, p)
        Rows of a group of r get one weight, by the norm of their residuals. Known precision of an equation
        is brought in by multiplying both of its sides.
    wanted : ndarray, shape (n,) or (n, r)
    weights : callable
        Weights of residuals over their robust standard deviation: `huber_weights` or `cauchy_weights`.
    rounds : int
        Solutions; the first with equal weights.
    rcond : float, optional
        Ratio of singular values below which a direction counts as not determined; see `numpy.linalg.lstsq`.
    smallest_sigma : float
        Smallest standard deviation of residuals that are more than rounding.

    References
    ----------
    .. [1] P. W. Holland and R. E. Welsch, "Robust regression using iteratively reweighted least-squares",
       Commun. Stat. Theory Methods, 1977.
    """
    rows, values = matrix.reshape(-1, matrix.shape[-1]), wanted.ravel()
    group = values.size // len(wanted)
    weight = np.ones(len(wanted))
    for left in range(rounds, 0, -1):
        root = np.repeat(np.sqrt(weight), group)
        weighted = rows * root[:, None]
        found, _, rank, _ = np.linalg.lstsq(weighted, values * root, rcond=rcond)
        residuals = rows @ found - values
        size = np.abs(residuals) if group == 1 else np.linalg.norm(residuals.reshape(-1, group), axis=1)
        sigma = robust_sigma(size, smallest_sigma)
        if left > 1:
            weight = weights(size / sigma)
    shaped = residuals.reshape(wanted.shape)
    return RobustFit(np.asarray(found), shaped, weight, sigma, int(rank), weighted.T @ weighted)


def clustered_covariance(
    jacobian: FloatArray, residuals: FloatArray, cluster: IntArray, lags: int = 0
) -> FloatArray:
    """Covariance of least squares whose residuals are correlated within clusters, and from one to the next.

    Parameters
    ----------
    jacobian : ndarray, shape (m, p)
    residuals : ndarray, shape (m,)
        Some to each point, in the order of the points.
    cluster : ndarray of int, shape (n,)
        Of each point; numbered in their order in time, if `lags` are given.
    lags : int
        Clusters so many apart may still be correlated (`correlated_lags`).

    References
    ----------
    .. [1] R. M. Bell and D. F. McCaffrey, "Bias reduction in standard errors for linear regression with
       multi-stage samples", Survey Methodology, 2002 (the jackknife form, CR3).
    .. [2] W. K. Newey and K. D. West, "A simple, positive semi-definite, heteroskedasticity and
       autocorrelation consistent covariance matrix", Econometrica, 1987.
    """
    index = np.unique(np.repeat(cluster, len(residuals) // len(cluster)), return_inverse=True)[1]
    bread = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-15, hermitian=True)
    order = np.argsort(index, kind="stable")
    counts = np.bincount(index)
    starts = np.cumsum(counts) - counts
    scores = np.zeros((len(counts), jacobian.shape[1]))
    for size in np.unique(counts):
        alike = np.flatnonzero(counts == size)
        members = order[starts[alike][:, None] + np.arange(size)]
        rows = jacobian[members]
        # What the residuals would be, had the cluster not pulled the solution towards itself.
        left = np.eye(size) - rows @ bread @ np.swapaxes(rows, 1, 2)
        unpulled = np.linalg.pinv(left, rcond=1e-9, hermitian=True) @ residuals[members][:, :, None]
        scores[alike] = (np.swapaxes(rows, 1, 2) @ unpulled)[:, :, 0]
    spread = scores.T @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        together = scores[lag:].T @ scores[:-lag]
        spread += (1.0 - lag / (lags + 1.0)) * (together + together.T)
    return np.asarray(bread @ spread @ bread)


def correlated_lags(residuals: FloatArray, cluster: IntArray) -> int:
    """How many clusters apart residuals are still correlated: up to where that could be chance.

    Parameters
    ----------
    residuals, cluster
        See `clustered_covariance`; the mean of each cluster counts.
    """
    index = np.unique(np.repeat(cluster, len(residuals) // len(cluster)), return_inverse=True)[1]
    means = np.bincount(index, residuals) / np.bincount(index)
    means = means - means.mean()
    energy, most = float(means @ means), len(means) // 4
    for lag in range(1, most + 1):
        if means[lag:] @ means[:-lag] < 2.0 * energy / np.sqrt(len(means)):
            return lag - 1
    return most


def _diagnose(
    x: FloatArray,
    r: FloatArray,
    j: FloatArray,
    names: tuple[str, ...],
    evaluations: int,
    converged: bool,
    message: str,
) -> Fit:
    norms = np.linalg.norm(j, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    _, singular, vt = np.linalg.svd(j / scale, full_matrices=False)
    known = singular > singular[0] * max(j.shape) * np.finfo(float).eps
    variance = float(r @ r) / max(r.size - x.size, 1)
    inverse = (vt[known].T / singular[known] ** 2) @ vt[known]
    covariance = variance * inverse / np.outer(scale, scale)
    blind = (np.abs(vt[~known]) > 1e-6).any(axis=0)
    covariance[np.ix_(blind, blind)] = np.inf
    return Fit(
        parameters=x,
        names=names,
        residuals=r,
        covariance=covariance,
        singular_values=singular,
        weakest_direction=vt[-1],
        evaluations=int(evaluations),
        converged=bool(converged),
        message=str(message),
    )
