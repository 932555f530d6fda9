"""Clock offset between images and a sensor, from a plane's echo line: its depth and slope follow the sensor.

The line's depth is a linear function of a tracker's position and, for small turns, of its rotation; its slope
is one of an orientation sensor's rotation. The function is fitted anew for every delay that is tried; the
best delay leaves the least residual.

References
----------
.. [1] G. M. Treece, A. H. Gee, R. W. Prager, C. J. C. Cash and L. H. Berman, "High-definition freehand 3-D
   ultrasound", Ultrasound in Medicine and Biology 29, 2003 (from onsets of abrupt motion; here all motion is
   used).
.. [2] M. Ezekiel, "Methods of correlation analysis", 1930 (the adjusted coefficient of determination).
"""

from __future__ import annotations

import numpy as np

from calibration.clock.offset import SEARCH_S, ClockOffset, SmoothReadings, covered, delays_around, peak_of
from calibration.solution import autocorrelation_time
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedPoses, TimedRotations

STEP_S = 0.005

LEAST_SHARE = 0.8
"""Share of the line's variance that the sensor must explain. Readings with a quarter of noise, or turns that
are not small, fit best at wrong delays."""

FEWEST_FRAMES = 20

_STILL = 1e-9
"""Range of a line's depth or slope, mm or rad, that is only rounding."""

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
    inside = covered(readings, frame_time_s, around_s, search_s)
    if inside.sum() < FEWEST_FRAMES:
        raise InsufficientDataError(
            f"expected readings from {search_s:g} s before to {search_s:g} s after at least {FEWEST_FRAMES} "
            f"frames with a line, got them for {inside.sum()} of {len(frame_time_s)} such frames"
        )
    times, target = frame_time_s[inside], signal[inside, 0 if isinstance(readings, TimedPoses) else 1]
    target = target - target.mean()
    if float(np.ptp(target)) < _STILL:
        raise InsufficientDataError("expected a line that moves, got one that stands still")
    steady = SmoothReadings(readings)

    def fit(delay_s: float) -> tuple[FloatArray, int]:
        """Residual of the line after a linear fit of rotation and position, and the fit's rank."""
        turns, places = (pose := steady.at(times - delay_s)).rotation, pose.translation
        motion = [(turns.mean().inv() * turns).as_rotvec(), places - places.mean(axis=0)]
        matrix = np.column_stack([np.ones(len(times)), *motion])
        answer, _, rank, _ = np.linalg.lstsq(matrix, target, rcond=1e-9)
        return target - matrix @ answer, int(rank)

    def misfit(delay_s: float) -> float:
        left = fit(delay_s)[0]
        return float(left @ left / (target @ target))

    delays = delays_around(around_s, search_s, STEP_S)
    misfits = np.array([misfit(float(delay)) for delay in delays])
    if (share := 1.0 - misfits.min()) < LEAST_SHARE:
        raise InsufficientDataError(
            f"expected a line that follows the sensor, got {100 * share:.0f} % of its motion explained at "
            f"the best delay, {delays[misfits.argmin()]:+.3f} s: move the probe up and down, faster; or the "
            "delay lies outside the range searched: --search-s"
        )
    best = peak_of(delays, misfits, f"the motion repeats itself, or does not return: {_IRREGULARLY}")
    near = slice(best - 1, best + 2)
    bend, tilt, _ = np.polyfit(delays[near] - delays[best], misfits[near], 2)
    seconds, curvature = float(delays[best] - tilt / (2.0 * bend)), float(2.0 * bend)
    left, rank = fit(seconds)
    least = float(left @ left / (target @ target))
    # Of few independent values any slow motion explains a line at some delay, which is fitted too: the share
    # explained is adjusted for the numbers fitted [2]_.
    count, unknowns = len(target) / autocorrelation_time(target), rank + 1
    if least * (count - 1.0) > (1.0 - LEAST_SHARE) * (count - unknowns):
        raise InsufficientDataError(
            f"expected a line whose motion has many more independent values than the {unknowns} numbers "
            f"fitted to it, got {count:.1f}: record for longer, and {_IRREGULARLY}"
        )
    free = max(1.0, len(left) / autocorrelation_time(left) - rank)
    error = float(np.sqrt(2.0 * least / free / curvature)) if curvature > 0 else np.inf
    if not error < search_s:
        raise InsufficientDataError(
            f"expected a motion that shows the delay, got {seconds:+.3f} s +- {error:.3g} s, no better than "
            f"the {search_s:g} s searched: {_IRREGULARLY}"
        )
    return ClockOffset(seconds, error, 1.0 - least)
