"""Readings of a sensor between its samples, by smoothing splines instead of straight lines.

A straight line between two samples halves the variance of their white noise midway and leaves it at the
samples, so that a misfit as a function of the clock's offset has a bump at every sample. A smoothing spline
has nearly the same noise at all times. How stiff it is the samples say themselves: every other one predicts
those between.

References
----------
.. [1] G. Wahba, "Spline models for observational data", SIAM, 1990, chapters 1 and 4.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline, make_smoothing_spline
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.streams import TimedPoses, TimedRotations

_FEWEST = 6
"""Samples of a smoothing spline; fewer are joined by straight lines."""
_STIFFNESS = 10.0 ** np.arange(-3.0, 4.0)
"""Tried, in samples to the fourth power: from the samples themselves to waves of 35 samples."""
_MOST_SAMPLES = 600
"""Samples among which stiffness is chosen."""


class SmoothReadings:
    """Poses at any time, from splines through each stretch without a long gap; rotations have no place."""

    def __init__(self, readings: TimedPoses | TimedRotations) -> None:
        time_s, samples = readings.time_s, readings.world_from_sensor
        self.time_s = time_s
        self.poses = samples if isinstance(samples, RigidTransform) else RigidTransform.from_rotation(samples)
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
