"""A sensor's clock offset: the result, readings at any time, and the search for the best delay.

Readings between samples are those of smoothing splines, not of straight lines. A straight line between two
samples halves the variance of their white noise midway and leaves it at the samples, so that a misfit as a
function of the offset has a bump at every sample. A smoothing spline has nearly the same noise at all times.
How stiff it is the samples say themselves: every other one predicts those between.

References
----------
.. [1] G. Wahba, "Spline models for observational data", SIAM, 1990, chapters 1 and 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline, make_smoothing_spline
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import rigid
from speckle3d.core.streams import TimedPoses, TimedRotations

SEARCH_S = 0.5
"""How far to either side of the known delay others are tried."""

_AMBIGUOUS = 0.1
"""Another delay counts as a rival if it is worse by less than this share of what the best delay gains."""
_FEWEST = 6
"""Samples of a smoothing spline; fewer are joined by straight lines."""
_STIFFNESS = 10.0 ** np.arange(-3.0, 4.0)
"""Tried, in samples to the fourth power: from the samples themselves to waves of 35 samples."""
_MOST_SAMPLES = 600
"""Samples among which stiffness is chosen."""


@dataclass(frozen=True)
class ClockOffset:
    """A sensor's clock offset: a reading at t belongs to image time t + `seconds`.

    Attributes
    ----------
    standard_error_s : float
    followed : float
        How well images and sensor agree at this offset: the share of a line's variance that the sensor's
        motion explains, or the mean correlation of images with reslices. NaN where neither was measured.
    """

    seconds: float
    standard_error_s: float
    followed: float = float("nan")


def covered(
    readings: TimedPoses | TimedRotations, frame_time_s: FloatArray, offset_s: float, slack_s: float = 0.0
) -> BoolArray:
    """Mask of frames with a reading, for any offset within `slack_s` of `offset_s`."""
    # Steps too small to miss a gap.
    steps = np.linspace(-slack_s, slack_s, 1 + ceil(2.0 * slack_s / readings.max_gap_s))
    return np.asarray(np.all([readings.covers(frame_time_s - offset_s - step) for step in steps], axis=0))


def delays_around(around_s: float, search_s: float, step_s: float) -> FloatArray:
    """Delays from `around_s` - `search_s` to `around_s` + `search_s`, a step apart."""
    steps = np.arange(-round(search_s / step_s), round(search_s / step_s) + 1)
    return np.asarray(around_s + steps * step_s, dtype=np.float64)


def peak_of(tried_s: FloatArray, misfit: FloatArray, doubt: str) -> int:
    """Index of the delay of least misfit.

    Parameters
    ----------
    doubt : str
        Likely reason of a rival, for the message.

    Raises
    ------
    InsufficientDataError
        If it lies at the end of the range, or another is nearly as good.
    """
    best = int(np.argmin(misfit))
    if best in (0, len(tried_s) - 1):
        raise InsufficientDataError(
            f"expected a delay between {tried_s[0]:g} and {tried_s[-1]:g} s, got the best at the range's "
            "end: the delay may lie outside the range searched: --search-s"
        )
    from scipy.signal import find_peaks  # half a second, which a known delay has no need of

    gain = float(np.median(misfit) - misfit[best])
    good = find_peaks(-misfit, height=-(misfit[best] + _AMBIGUOUS * gain))[0]
    # Not by find_peaks' prominence: the range may end before the misfit rises beyond a rival.
    for rival in good[good != best]:
        if misfit[min(rival, best) : max(rival, best)].max() - misfit[best] > 0.5 * gain:
            pair = f"{tried_s[best]:+.3f} and {tried_s[rival]:+.3f} s"
            raise InsufficientDataError(f"expected one delay, got {pair} nearly as good: {doubt}")
    return best


class SmoothReadings:
    """Poses at any time, from splines through each stretch without a long gap; rotations have no place."""

    def __init__(self, readings: TimedPoses | TimedRotations) -> None:
        time_s, samples = readings.time_s, readings.world_from_sensor
        self.time_s = time_s
        self.poses = rigid(samples)
        places, turns = self.poses.translation, self.poses.rotation.as_quat()
        back = np.append(False, np.sum(turns[1:] * turns[:-1], axis=1) < 0)
        turns = turns * np.where(np.cumsum(back) % 2, -1.0, 1.0)[:, None]
        self._readings = readings
        self._period = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
        at = time_s / self._period
        stiffness = [(columns, _stiffness(at, columns)) for columns in (turns, places)]
        parts = np.split(np.arange(len(at)), np.flatnonzero(np.diff(time_s) > readings.max_gap_s) + 1)
        self._begins = at[[part[0] for part in parts]]
        self._curves = [[_spline(at[p], columns[p], stiff) for columns, stiff in stiffness] for p in parts]

    def at(self, times_s: npt.ArrayLike) -> RigidTransform:
        """Pose at each of `times_s`; raises as `TimedPoses.at` does."""
        at = np.atleast_1d(self._readings.require_covered(times_s)) / self._period
        stretch = np.searchsorted(self._begins[1:], at, side="right")
        turns, places = np.empty((len(at), 4)), np.empty((len(at), 3))
        for number in np.unique(stretch):
            inside = stretch == number
            turns[inside], places[inside] = (curve(at[inside]) for curve in self._curves[number])
        return RigidTransform.from_components(places, Rotation.from_quat(turns))


def _stiffness(at: FloatArray, columns: FloatArray) -> float:
    """Stiffness with which every other sample predicts those between them best."""
    at, columns = at[:_MOST_SAMPLES], columns[:_MOST_SAMPLES]
    if len(at) < 2 * _FEWEST:
        return float(_STIFFNESS[0])
    between = slice(1, (len(at) - 1) // 2 * 2, 2)
    misses = [
        np.abs(_spline(at[::2] / 2.0, columns[::2], stiffness)(at[between] / 2.0) - columns[between]).sum()
        for stiffness in _STIFFNESS
    ]
    # Of a wave the filter is the same at half the samples if the stiffness is a sixteenth.
    return 16.0 * float(_STIFFNESS[np.argmin(misses)])


def _spline(at: FloatArray, columns: FloatArray, stiffness: float) -> BSpline:
    if len(at) >= _FEWEST:
        return make_smoothing_spline(at, columns, lam=stiffness)
    return make_interp_spline(at, columns, k=min(1, len(at) - 1))
