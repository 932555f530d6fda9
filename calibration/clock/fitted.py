"""A sensor's clock offset as one more parameter of a calibration with a phantom.

The residuals change with the offset as the sensor moves: their derivative is one more column of the
calibration's Jacobian, and the offset is solved for together with the calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibration.chain import CHAIN, ChainSolution, ImagePoints, residuals_and_jacobian
from calibration.clock.offset import ClockOffset, delays_around
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.leastsquares import clustered_covariance

STEP_S = 0.04
"""Offsets tried first: a quarter of a period of 6 Hz, faster than hands swing a probe."""

_MOST_STEPS = 12
_SETTLED = 0.02
"""Steps end when one is below this share of the standard error."""
_DERIVATIVE_S = 1e-3


def estimate_offset(
    calibrate: Callable[[ImagePoints], ChainSolution],
    points_at: Callable[[float], ImagePoints],
    around_s: float = 0.0,
    search_s: float = 0.4,
) -> ClockOffset:
    """Find the clock offset with which a calibration explains its points best.

    Parameters
    ----------
    calibrate : callable
        May raise `InsufficientDataError`.
    points_at : callable
        The same points with the sensor read at a given offset, smoothly (`calibration.clock.smoothing`).
    around_s, search_s : float
        Offsets from `around_s` - `search_s` to `around_s` + `search_s` are tried.

    Raises
    ------
    InsufficientDataError
        If no offset gives a calibration, the best is at the end of the range, or another is as good.
    """
    tried = delays_around(around_s, search_s, STEP_S)
    sigmas = np.array([_sigma(calibrate, points_at(float(offset))) for offset in tried])
    best = int(np.argmin(sigmas))
    if not np.isfinite(sigmas[best]):
        raise InsufficientDataError(
            f"expected a clock offset within {search_s:g} s that gives a calibration, got none"
        )
    seconds = float(tried[best])
    for _ in range(_MOST_STEPS):
        solution = calibrate(points_at(seconds))
        step, error = offset_step(solution, points_at, seconds)
        seconds += float(np.clip(step, -STEP_S, STEP_S))
        if not abs(seconds - around_s) <= search_s - _DERIVATIVE_S:
            raise InsufficientDataError(
                f"expected a clock offset within {search_s:g} s of {around_s:g} s, got the best at its end"
            )
        if abs(step) < _SETTLED * error:
            break
    return ClockOffset(seconds, error)


def offset_step(
    solution: ChainSolution, points_at: Callable[[float], ImagePoints], seconds: float
) -> tuple[float, float]:
    """Step of the offset that lowers the residuals most, all parameters free, and its standard error, s."""
    jacobian = with_offset(solution, points_at, seconds)
    residuals = solution.residuals[solution.used].ravel()
    step = -np.linalg.lstsq(jacobian, residuals, rcond=1e-12)[0]
    covariance = clustered_covariance(jacobian, residuals, solution.points_used.frame)
    return float(step[-1]), float(np.sqrt(covariance[-1, -1]))


def with_offset(
    solution: ChainSolution, points_at: Callable[[float], ImagePoints], seconds: float
) -> FloatArray:
    """Derivatives of the residuals used by the free parameters and by the offset, shape (n r, p + 1).

    The parameters are those of frames that lie on the image and on the phantom (`ChainSolution.fit`).
    """
    used, phantom = solution.points_used, solution.phantom
    near = replace(used, world_from_sensor=solution.chain.target_from_image(used))
    origin = np.concatenate([solution.chain.pixel_mm, np.zeros(len(CHAIN) - 2)])
    _, jacobian = residuals_and_jacobian(origin, near, phantom)
    columns = jacobian.reshape(-1, len(CHAIN))[:, solution.free_columns]
    later, sooner = (
        residuals_and_jacobian(solution.chain.parameters(), points_at(at)[solution.used], phantom)[0]
        for at in (seconds + _DERIVATIVE_S, seconds - _DERIVATIVE_S)
    )
    return np.column_stack([columns, (later - sooner).ravel() / (2.0 * _DERIVATIVE_S)])


def _sigma(calibrate: Callable[[ImagePoints], ChainSolution], points: ImagePoints) -> float:
    try:
        return calibrate(points).sigma
    except InsufficientDataError:
        return float("inf")
