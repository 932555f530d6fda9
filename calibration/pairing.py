"""Which sensor reading belongs to which frame, and by how much the sensor's clock is off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from calibration.solution import Solution
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import FloatArray
from speckle3d.core.streams import BoolArray, TimedPoses, TimedRotations

_STEP_S = 0.02
"""Coarse steps of the offset: half a frame at 25 frames/s, in which no hand reverses."""

_TOLERANCE_S = 1e-4


@dataclass(frozen=True)
class Offset:
    """A sensor's clock offset: a reading at t belongs to image time t + `seconds`."""

    seconds: float
    standard_error_s: float


def covered(
    readings: TimedPoses | TimedRotations, frame_time_s: FloatArray, offset_s: float, slack_s: float = 0.0
) -> BoolArray:
    """Which frames have a reading, for any offset within `slack_s` of `offset_s`."""
    shifts = {-slack_s, 0.0, slack_s}
    return np.asarray(np.all([readings.covers(frame_time_s - offset_s - shift) for shift in shifts], axis=0))


def estimate_offset(
    calibrate: Callable[[float], Solution], around_s: float = 0.0, search_s: float = 0.4
) -> Offset:
    """Find the clock offset with which a calibration explains its lines best.

    Parameters
    ----------
    calibrate : callable
        Calibrates with the sensor read at a given offset; may raise `InsufficientDataError`.
    around_s, search_s : float
        Offsets from `around_s` - `search_s` to `around_s` + `search_s` are tried.

    Raises
    ------
    InsufficientDataError
        If no offset gives a calibration, or the best is at the end of the range.
    """
    tried = around_s + np.arange(-round(search_s / _STEP_S), round(search_s / _STEP_S) + 1) * _STEP_S
    sigmas = np.array([_sigma(calibrate, float(offset)) for offset in tried])
    best = int(np.argmin(sigmas))
    if not np.isfinite(sigmas[best]):
        raise InsufficientDataError(
            f"expected a clock offset within {search_s:g} s that gives a calibration, got none"
        )
    if best in (0, len(tried) - 1):
        raise InsufficientDataError(
            f"expected a clock offset within {search_s:g} s of {around_s:g} s, got the best at its end"
        )
    used = calibrate(float(tried[best])).used

    def cost(offset: float) -> float:
        return float(np.sum(calibrate(offset).residuals[used] ** 2))

    near = minimize_scalar(
        cost, bounds=(tried[best - 1], tried[best + 1]), method="bounded", options={"xatol": _TOLERANCE_S}
    )
    return Offset(float(near.x), _standard_error(cost, float(near.x), int(used.sum())))


def _sigma(calibrate: Callable[[float], Solution], offset: float) -> float:
    try:
        return calibrate(offset).sigma
    except InsufficientDataError:
        return float("inf")


def _standard_error(cost: Callable[[float], float], offset: float, count: int) -> float:
    """From the curvature of the sum of squares, as for any parameter of a least-squares fit."""
    below, middle, above = (cost(offset + step) for step in (-_STEP_S, 0.0, _STEP_S))
    curvature = (below - 2.0 * middle + above) / _STEP_S**2
    return float(np.sqrt(2.0 * middle / count / curvature)) if curvature > 0 else float("inf")
