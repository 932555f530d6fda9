"""A sensor's clock offset as one more parameter of a calibration with a phantom.

The residuals change with the offset as the sensor moves: their derivative is one more column of the
calibration's Jacobian, and the offset is solved for together with the calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from calibration.clock.offset import ClockOffset, SmoothReadings, covered, delays_around, peak_of
from calibration.motion import InadequateError
from calibration.noise import fit_noise
from calibration.points import SOME_FRAMES, ImagePoints, as_directions
from calibration.solution import Solution, sigma_of
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses, TimedRotations

STEP_S = 0.04
"""Steps of the offsets tried first: a frame at 25 frames/s, in which no hand reverses."""

_MOST_STEPS = 10
_CLOSE = 0.1
"""Steps end when one is below this share of the standard error."""
_DERIVATIVE_S = 1e-3

Calibrate = Callable[[ImagePoints], Solution]


def estimate_offset(
    calibrate: Calibrate,
    points: ImagePoints,
    readings: TimedPoses | TimedRotations,
    around_s: float,
    search_s: float,
) -> ClockOffset:
    """Find the clock offset with which a calibration explains its points best.

    Parameters
    ----------
    calibrate : callable
        May raise `InsufficientDataError`.
    points : ImagePoints
        With times; those that have a reading at every offset tried are used, so that all offsets are judged
        by the same points.
    readings : TimedPoses or TimedRotations
    around_s, search_s : float
        Offsets from `around_s` - `search_s` to `around_s` + `search_s` are tried.

    Raises
    ------
    InsufficientDataError
        If readings cover no frame at all offsets, no offset gives a calibration, the best is at the end of
        the range, or another is as good.
    """
    covered_points = covered(readings, points.times, around_s, search_s)
    if not covered_points.any():
        raise InsufficientDataError(
            f"expected readings from {search_s:g} s before to {search_s:g} s after some frames, to tell the "
            "clock, got none"
        )
    points_at = _reader(points[covered_points], readings)
    delays = delays_around(around_s, search_s, STEP_S)
    misfit = np.full(len(delays), np.nan)
    for number, offset in enumerate(delays):
        with suppress(InsufficientDataError):
            few = points_at(float(offset)).of_some_frames(SOME_FRAMES)
            misfit[number] = sigma_of(_adequate_or_not(calibrate, few).residuals) ** 2
    if not np.isfinite(misfit).any():
        raise InsufficientDataError(
            f"expected a clock offset that gives a calibration, got none of {len(delays)}"
        )
    misfit = np.nan_to_num(misfit, nan=np.nanmax(misfit))
    seconds = float(delays[peak_of(delays, misfit, "the motion repeats itself; move irregularly")])
    for _ in range(_MOST_STEPS):
        # Anew, for the frames that contradict the others depend on the offset.
        step, covariance = _joint_fit(_adequate_or_not(calibrate, points_at(seconds)), points_at, seconds)
        error = float(np.sqrt(covariance[-1, -1]))
        seconds += float(np.clip(step, -STEP_S, STEP_S))
        if not abs(seconds - around_s) < search_s - STEP_S:
            raise InsufficientDataError(
                f"expected a clock offset within {search_s:g} s of {around_s:g} s, got the best at its end"
            )
        if abs(step) < _CLOSE * error:
            break
    return ClockOffset(seconds, error)


def with_uncertain_offset(
    solution: Solution, points: ImagePoints, readings: TimedPoses | TimedRotations, seconds: float
) -> Solution:
    """Return a solution whose covariance includes that of the clock offset that its points were read with."""
    covered_points = covered(readings, points.times, seconds, _DERIVATIVE_S)
    _, joint = _joint_fit(solution, _reader(points[covered_points], readings), seconds)
    along, variance = joint[:-1, -1], joint[-1, -1]
    return replace(solution, covariance=solution.covariance + np.outer(along, along) / variance)


def _reader(points: ImagePoints, readings: TimedPoses | TimedRotations) -> Callable[[float], ImagePoints]:
    """Points with the sensor read at another offset, each time of a frame once."""
    smooth = SmoothReadings(readings)
    times, of_point = np.unique(points.times, return_inverse=True)
    return lambda seconds: replace(points, world_from_sensor=smooth.at(times - seconds)[of_point])


def _joint_fit(
    solution: Solution, points_at: Callable[[float], ImagePoints], seconds: float
) -> tuple[float, FloatArray]:
    """Solve for chain and offset together: the offset's step, s, and the covariance of both.

    The covariance is that of the free parameters, in frames that lie on the image and on the phantom, and of
    the offset after them.
    """
    phantom, chain, frames = solution.phantom, solution.chain, solution.points_used.frames
    equations = []
    for step in (-_DERIVATIVE_S, 0.0, _DERIVATIVE_S):
        points = points_at(seconds + step)
        points = points[np.isin(points.frame, frames)]
        points = as_directions(points, chain.pixel_mm) if solution.angular else points
        equations.append(phantom.equations(points))
    sooner, middle, later = equations
    column = (later.residuals(chain) - sooner.residuals(chain)).reshape(-1, 1) / (2.0 * _DERIVATIVE_S)
    _, further, joint = fit_noise(middle, chain, solution.free, phantom.seen_as, solution.prior, column)
    return float(further[-1]), joint


def _adequate_or_not(calibrate: Calibrate, points: ImagePoints) -> Solution:
    """Calibrate without the test of the motion, which fails at wrong offsets."""
    try:
        return calibrate(points)
    except InadequateError as refused:
        if refused.solution is None:
            raise
        return refused.solution
