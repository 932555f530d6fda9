"""Which sensor reading belongs to which frame, and by how much the sensor's clock is off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from calibration.chain import ChainSolution
from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses, TimedRotations

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
    asked, sampled = np.asarray(frame_time_s) - offset_s, readings.time_s
    inside = (asked - slack_s >= sampled[0]) & (asked + slack_s <= sampled[-1])
    gaps = np.flatnonzero(np.diff(sampled) > readings.max_gap_s)
    first, last = asked[:, None] - slack_s, asked[:, None] + slack_s
    in_gap = (last > sampled[gaps]) & (first < sampled[gaps + 1])
    return np.asarray(inside & ~in_gap.any(axis=1))


def estimate_offset(
    calibrate: Callable[[float], ChainSolution], around_s: float = 0.0, search_s: float = 0.4
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
    # The last step but one does not count either: the curvature is measured a step further on.
    if not 1 < best < len(tried) - 2:
        raise InsufficientDataError(
            f"expected a clock offset within {search_s:g} s of {around_s:g} s, got the best at its end"
        )
    nearest = calibrate(float(tried[best]))
    used, count = nearest.used, nearest.residuals[nearest.used].size

    def cost(offset: float) -> float:
        return float(np.sum(calibrate(offset).residuals[used] ** 2))

    near = minimize_scalar(
        cost, bounds=(tried[best - 1], tried[best + 1]), method="bounded", options={"xatol": _TOLERANCE_S}
    )
    return Offset(float(near.x), _standard_error(cost, float(near.x), count))


def _sigma(calibrate: Callable[[float], ChainSolution], offset: float) -> float:
    try:
        return calibrate(offset).sigma
    except InsufficientDataError:
        return float("inf")


def _standard_error(cost: Callable[[float], float], offset: float, count: int) -> float:
    """From the curvature of the sum of squares, as for any parameter of a least-squares fit."""
    below, middle, above = (cost(offset + step) for step in (-_STEP_S, 0.0, _STEP_S))
    curvature = (below - 2.0 * middle + above) / _STEP_S**2
    return float(np.sqrt(2.0 * middle / count / curvature)) if curvature > 0 else float("inf")
