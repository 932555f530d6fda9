"""Clock offset between images and a sensor, from a plane's echo line: its depth and slope follow the sensor.

The line's depth is a linear function of a tracker's position and, for small turns, of its rotation; its slope
is one of an orientation sensor's rotation. The function is fitted anew for every delay that is tried; the
best delay leaves the least residual.

References
----------
.. [1] G. M. Treece, A. H. Gee, R. W. Prager, C. J. C. Cash and L. H. Berman, "High-definition freehand 3-D
   ultrasound", Ultrasound in Medicine and Biology 29, 2003 (from onsets of abrupt motion; here all motion is
   used).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.clock.offset import (
    SEARCH_S,
    ClockOffset,
    covered,
    curvature_error,
    delays_around,
    minimum_between,
    require_peak,
)
from calibration.clock.smoothing import smooth
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.leastsquares import autocorrelation_time
from speckle3d.core.streams import TimedPoses, TimedRotations

STEP_S = 0.005

LEAST_FOLLOWED = 0.8
"""Share of the line's variance that the sensor must explain. Readings with a quarter of noise, or turns that
are not small, fit best at wrong delays."""

FEWEST_FRAMES = 20

_STILL = 1e-9
"""Range of a line's depth or slope, mm or rad, that is only rounding."""

_TREND = 0.95
"""Share of the variance that constant speed may explain; more, and the motion fits at any delay."""

_ONE_WAY = "the motion goes one way and does not return: move the probe up and down"
_IRREGULARLY = "move the probe up and down, irregularly"


def line_signal(points_px: FloatArray, pixel_mm: FloatArray, column: float) -> FloatArray:
    """Depth at one column, mm, and slope, rad, of every line, shape (m, 2).

    Parameters
    ----------
    points_px : ndarray, shape (m, 2, 2)
        Two points (column, row) on each line.
    """
    (x0, y0), (x1, y1) = (points_px[:, end].T for end in (0, 1))
    slope = (y1 - y0) / (x1 - x0)
    depth_mm = (y0 + slope * (column - x0)) * pixel_mm[1]
    return np.column_stack([depth_mm, np.arctan(slope * pixel_mm[1] / pixel_mm[0])])


def delay_from_lines(
    signal: FloatArray,
    frame_time_s: FloatArray,
    readings: TimedPoses | TimedRotations,
    around_s: float = 0.0,
    search_s: float = SEARCH_S,
) -> ClockOffset:
    """Find the delay at which a plane's line follows the sensor best.

    Parameters
    ----------
    signal : ndarray, shape (m, 2)
        Depth and slope of the line in each frame (`line_signal`); a tracker explains the depth, an
        orientation sensor the slope.
    frame_time_s : ndarray, shape (m,)
    around_s, search_s : float
        Delays from `around_s` - `search_s` to `around_s` + `search_s` are tried.

    Raises
    ------
    InsufficientDataError
        If too few frames have readings at all these delays, the line does not follow the sensor, the best
        delay is at the end of the range, or another is as good, as with a periodic motion.
    """
    there = covered(readings, frame_time_s, around_s, search_s)
    if there.sum() < FEWEST_FRAMES:
        raise InsufficientDataError(
            f"expected readings from {search_s:g} s before to {search_s:g} s after at least {FEWEST_FRAMES} "
            f"frames with a line, got them for {there.sum()} of {len(frame_time_s)} such frames"
        )
    wanted = signal[there, 0 if isinstance(readings, TimedPoses) else 1]
    misfit_at = _misfit(wanted - wanted.mean(), frame_time_s[there], readings)
    tried = delays_around(around_s, search_s, STEP_S)
    misfit = np.array([misfit_at(float(delay)) for delay in tried], dtype=np.float64)
    best = int(np.argmin(misfit))
    returns = _returns(wanted, frame_time_s[there])
    _require_clear(tried, misfit, best, returns)
    motion = _motion(readings, frame_time_s[there] - tried[best])
    _require_varied(wanted - wanted.mean(), motion, float(misfit[best]))
    # Between the delays tried, samples joined by straight lines would pull the best one to a sample.
    steady = smooth(readings)
    misfit_at = _misfit(wanted - wanted.mean(), frame_time_s[there], steady)
    delay, least = minimum_between(misfit_at, tried, best, 1e-5)
    motion = _motion(steady, frame_time_s[there] - delay)
    left = _residuals(wanted, motion)
    free = max(1.0, len(left) / autocorrelation_time(left) - motion.shape[1])
    error = curvature_error(misfit_at, delay, STEP_S, free)
    if not error < search_s:
        raise InsufficientDataError(
            f"expected a motion that shows the delay, got {delay:+.3f} s +- {error:.3g} s, no better than "
            f"the {search_s:g} s searched: {_IRREGULARLY if returns else _ONE_WAY}"
        )
    return ClockOffset(delay, error, 1.0 - least)


def _motion(readings: TimedPoses | TimedRotations, times_s: FloatArray) -> FloatArray:
    """Regressors of a line: one, rotation about the mean, and position, shape (m, 4 or 7)."""
    read: RigidTransform | Rotation = readings.at(times_s)
    turn = read if isinstance(read, Rotation) else read.rotation
    columns = [np.ones((len(times_s), 1)), (turn.mean().inv() * turn).as_rotvec()]
    if not isinstance(read, Rotation):
        columns.append(read.translation - read.translation.mean(axis=0))
    return np.concatenate(columns, axis=1)


def _misfit(
    wanted: FloatArray, times_s: FloatArray, readings: TimedPoses | TimedRotations
) -> Callable[[float], float]:
    """Share of the signal's variance that the sensor leaves unexplained, as a function of the delay."""
    energy = float(wanted @ wanted)
    if float(np.ptp(wanted)) < _STILL:
        raise InsufficientDataError("expected a line that moves, got one that stands still")

    def at(delay_s: float) -> float:
        left = _residuals(wanted, _motion(readings, times_s - delay_s))
        return float(left @ left) / energy

    return at


def _residuals(wanted: FloatArray, motion: FloatArray) -> FloatArray:
    found = np.linalg.lstsq(motion, wanted, rcond=1e-9)[0]
    return np.asarray(wanted - motion @ found)


def _require_varied(wanted: FloatArray, motion: FloatArray, least_misfit: float) -> None:
    """Refuse a line with so few independent values that any slow motion would explain it at some delay."""
    # The delay is fitted too.
    count, fitted = (
        len(wanted) / autocorrelation_time(wanted),
        int(np.linalg.matrix_rank(motion, rtol=1e-9)) + 1,
    )
    by_any = (count - 1.0) / (count - fitted) if count > fitted else float("inf")
    if not least_misfit * by_any <= 1.0 - LEAST_FOLLOWED:
        raise InsufficientDataError(
            f"expected a line whose motion tells much more than the {fitted} numbers fitted to it, got one "
            f"that turns so seldom that it tells {count:.1f}: record for longer, and {_IRREGULARLY}"
        )


def _returns(wanted: FloatArray, times_s: FloatArray) -> bool:
    """Whether the line does more than go one way at one speed."""
    trend = np.polynomial.Polynomial.fit(times_s, wanted, 1)(times_s)
    return float(np.var(wanted - trend)) > (1.0 - _TREND) * float(np.var(wanted))


def _require_clear(tried_s: FloatArray, misfit: FloatArray, best: int, returns: bool) -> None:
    """Refuse a line that does not follow the sensor, and a best delay at the range's end or with a rival."""
    if 1.0 - misfit[best] < LEAST_FOLLOWED:
        raise InsufficientDataError(
            f"expected a line that follows the sensor, got {100 * (1 - misfit[best]):.0f} % of its motion "
            f"explained at the best delay, {tried_s[best]:+.3f} s: move the probe up and down, faster; or "
            "the delay lies outside the range searched: --search-s"
        )
    try:
        require_peak(tried_s, misfit, best)
    except InsufficientDataError:
        if returns:
            raise
        raise InsufficientDataError(f"expected one delay, got many that fit alike: {_ONE_WAY}") from None
