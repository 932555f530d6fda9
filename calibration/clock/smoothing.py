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

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import overload

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.streams import TimedPoses, TimedRotations

Curve = Callable[[FloatArray], FloatArray]

_FEWEST = 6
"""Samples of a spline; fewer are joined by straight lines."""

_STIFFNESS = 10.0 ** np.arange(-3.0, 4.0)
"""Tried, in samples to the fourth power: from the samples themselves to waves of 35 samples."""

_MOST_COMPARED = 600
"""Samples among which stiffness is chosen."""


@dataclass(frozen=True)
class _Curves:
    """Smoothing splines through columns of samples, one for each stretch without a long gap."""

    begins_s: FloatArray
    curves: list[list[Curve]]

    @classmethod
    def of(cls, readings: TimedPoses | TimedRotations) -> _Curves:
        turns, places = readings.components
        back = np.sum(turns[1:] * turns[:-1], axis=1) < 0
        turns = turns * np.where(np.cumsum(np.append(0, back)) % 2, -1.0, 1.0)[:, None]
        time_s = readings.time_s
        edges = np.flatnonzero(np.diff(time_s) > readings.max_gap_s) + 1
        parts = np.split(np.arange(len(time_s)), edges)
        period = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
        sets = [(columns, _stiffness(time_s / period, columns)) for columns in (turns, places)]
        return cls(
            time_s[[part[0] for part in parts]],
            [
                [
                    _curve(time_s[part], one, period, stiff)
                    for columns, stiff in sets
                    for one in columns[part].T
                ]
                for part in parts
            ],
        )

    def at(self, times_s: FloatArray) -> FloatArray:
        """Columns at each time, shape (q, c)."""
        stretch = np.maximum(np.searchsorted(self.begins_s, times_s, side="right") - 1, 0)
        found = np.empty((len(times_s), len(self.curves[0])))
        for number in np.unique(stretch):
            there = stretch == number
            found[there] = np.column_stack([curve(times_s[there]) for curve in self.curves[number]])
        return found


def _stiffness(places: FloatArray, columns: FloatArray) -> float:
    """Stiffness with which every other sample predicts those between them best."""
    at, values = places[:_MOST_COMPARED], columns[:_MOST_COMPARED]
    if len(at) < 2 * _FEWEST:
        return float(_STIFFNESS[0])
    inner = slice(1, -1 if len(at) % 2 == 0 else None, 2)

    def missed(stiffness: float) -> float:
        curves = [_curve(at[::2], one, 2.0, stiffness) for one in values[::2].T]
        return float(np.abs(np.column_stack([curve(at[inner]) for curve in curves]) - values[inner]).sum())

    # Of a wave the filter is the same at half the samples if the stiffness is a sixteenth.
    return 16.0 * float(min(_STIFFNESS, key=lambda one: missed(float(one))))


def _curve(time_s: FloatArray, values: FloatArray, period: float, stiffness: float) -> Curve:
    if len(time_s) < _FEWEST or np.ptp(values) == 0.0:
        return lambda times_s: np.asarray(np.interp(times_s, time_s, values))
    spline = make_smoothing_spline(time_s / period, values, lam=stiffness)
    return lambda times_s: np.asarray(spline(times_s / period))


class SmoothPoses(TimedPoses):
    """Poses that are read from smoothing splines."""

    @cached_property
    def _curves(self) -> _Curves:
        return _Curves.of(self)

    def at(self, times_s: npt.ArrayLike) -> RigidTransform:
        """Pose at each of `times_s`; raises as `TimedPoses.at` does."""
        found = self._curves.at(np.atleast_1d(self.require_covered(times_s)))
        turns = Rotation.from_quat(found[:, :4])
        return RigidTransform.from_components(found[:, 4:], turns)


class SmoothRotations(TimedRotations):
    """Rotations that are read from smoothing splines."""

    @cached_property
    def _curves(self) -> _Curves:
        return _Curves.of(self)

    def at(self, times_s: npt.ArrayLike) -> Rotation:
        """Rotation at each of `times_s`; raises as `TimedRotations.at` does."""
        found = self._curves.at(np.atleast_1d(self.require_covered(times_s)))
        return Rotation.from_quat(found[:, :4])


@overload
def smooth(readings: TimedPoses) -> SmoothPoses: ...
@overload
def smooth(readings: TimedRotations) -> SmoothRotations: ...
def smooth(readings: TimedPoses | TimedRotations) -> SmoothPoses | SmoothRotations:
    """Read the same samples from smoothing splines."""
    if isinstance(readings, TimedPoses):
        return SmoothPoses(readings.time_s, readings.world_from_sensor, readings.max_gap_s)
    return SmoothRotations(readings.time_s, readings.world_from_sensor, readings.max_gap_s)
