"""Readings of a sensor between its samples, by local parabolas instead of straight lines.

A straight line between two samples halves the variance of their white noise midway and leaves it at the
samples, so that a misfit as a function of the clock's offset has a bump at every sample. Parabolas fitted to
several samples have nearly the same noise at all times, and follow a hand's motion to its third derivative.

References
----------
.. [1] J. Fan and I. Gijbels, "Local polynomial modelling and its applications", 1996, chapters 3 and 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import overload

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.streams import TimedPoses, TimedRotations

_LONGEST_S = 0.1
"""Widest weights tried, s: a tenth of a period of 1.6 Hz, faster than hands swing a probe."""

_WIDER = 1.5
"""Ratio of the widths tried, the least of which is one sampling period."""

_REACH = 4.0
"""Samples farther than this many standard deviations of the weights do not count: those weigh 0.03 %."""

_FEWEST, _WITHIN = 5, 2.6
"""Where samples are missing, so many are within so many standard deviations, as with regular ones."""

_MOST_COMPARED = 400


@dataclass(frozen=True)
class _Parabolas:
    """Weighted parabolas through vectors near each time.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
    stretch : ndarray of int, shape (n,)
        Samples of other stretches, beyond a gap, do not count.
    """

    time_s: FloatArray
    stretch: IntArray

    @property
    def period_s(self) -> float:
        return float(np.median(np.diff(self.time_s)))

    def weights(
        self, times_s: FloatArray, width_s: float, left_out: IntArray | None = None
    ) -> tuple[IntArray, FloatArray]:
        """Samples near each time, shape (q, k), and their shares of the value there, which add to one."""
        nearest = self.nearest(times_s)
        few = min(_FEWEST, len(self.time_s))
        around = np.clip(nearest[:, None] + np.arange(-few, few + 1), 0, len(self.time_s) - 1)
        away = np.abs(self.time_s[around] - times_s[:, None])
        away[self._doubled(around)] = np.inf
        width = np.maximum(width_s, np.sort(away, axis=1)[:, few - 1] / _WITHIN)
        first = np.searchsorted(self.time_s, times_s - _REACH * width)
        last = np.searchsorted(self.time_s, times_s + _REACH * width, side="right")
        index = first[:, None] + np.arange(max(int((last - first).max()), 1))
        there = index < last[:, None]
        index = np.where(there, index, nearest[:, None])
        there &= self.stretch[index] == self.stretch[nearest][:, None]
        if left_out is not None:
            there &= index != left_out[:, None]
        x = (self.time_s[index] - times_s[:, None]) / width[:, None]
        weight = np.where(there, np.exp(-0.5 * x**2), 0.0)
        powers = np.stack([np.ones_like(x), x, x**2], axis=-1)
        moments = np.einsum("qk,qki,qkj->qij", weight, powers, powers)
        # Of fewer than three samples no parabola is determined: the least one through them.
        solved = np.linalg.pinv(moments, rcond=1e-10, hermitian=True)[:, 0]
        return index, weight * np.einsum("qi,qki->qk", solved, powers)

    def nearest(self, times_s: FloatArray) -> IntArray:
        """Sample nearest to each time."""
        right = np.clip(np.searchsorted(self.time_s, times_s), 1, len(self.time_s) - 1)
        left = right - 1
        nearer = times_s - self.time_s[left] < self.time_s[right] - times_s
        return np.asarray(np.where(nearer, left, right))

    @staticmethod
    def _doubled(index: IntArray) -> BoolArray:
        """Places that repeat the one before, at the ends of the samples."""
        same = np.zeros(index.shape, dtype=bool)
        same[:, 1:] = index[:, 1:] == index[:, :-1]
        return same


@dataclass(frozen=True)
class _Smooth:
    """The two parts of a pose, each with the width that predicts left-out samples best."""

    parabolas: _Parabolas
    rotation: Rotation
    translation: FloatArray | None

    def turned(self, times_s: FloatArray) -> Rotation:
        """Rotation at each time."""
        nearest, vectors = self._rotation_vectors(times_s, self._turning_s)
        return self.rotation[nearest] * Rotation.from_rotvec(vectors)

    def moved(self, times_s: FloatArray) -> FloatArray:
        """Translation at each time, shape (q, 3)."""
        return self._translations(times_s, self._moving_s)

    @cached_property
    def _turning_s(self) -> float:
        def missed(width_s: float, tried: IntArray) -> float:
            times = self.parabolas.time_s[tried]
            _, vectors = self._rotation_vectors(times, width_s, tried)
            return float(np.linalg.norm(vectors, axis=1).mean())

        return self._best(missed)

    @cached_property
    def _moving_s(self) -> float:
        def missed(width_s: float, tried: IntArray) -> float:
            assert self.translation is not None
            found = self._translations(self.parabolas.time_s[tried], width_s, tried)
            return float(np.linalg.norm(found - self.translation[tried], axis=1).mean())

        return self._best(missed)

    def _best(self, missed: Callable[[float, IntArray], float]) -> float:
        period = self.parabolas.period_s
        count = int(np.log(max(_LONGEST_S / period, 1.0)) / np.log(_WIDER)) + 1
        widths = period * _WIDER ** np.arange(count)
        last = len(self.parabolas.time_s) - 1
        tried = np.unique(np.linspace(0, last, min(_MOST_COMPARED, last + 1)).astype(int))
        return float(widths[int(np.argmin([missed(float(width), tried) for width in widths]))])

    def _rotation_vectors(
        self, times_s: FloatArray, width_s: float, left_out: IntArray | None = None
    ) -> tuple[IntArray, FloatArray]:
        """Nearest sample to each time, and the rotation vector from it, rad."""
        nearest = self.parabolas.nearest(times_s)
        index, share = self.parabolas.weights(times_s, width_s, left_out)
        base = np.repeat(nearest, index.shape[1])
        vectors = (self.rotation[base].inv() * self.rotation[index.ravel()]).as_rotvec()
        return nearest, np.einsum("qk,qki->qi", share, vectors.reshape(*index.shape, 3))

    def _translations(
        self, times_s: FloatArray, width_s: float, left_out: IntArray | None = None
    ) -> FloatArray:
        assert self.translation is not None
        index, share = self.parabolas.weights(times_s, width_s, left_out)
        return np.asarray(np.einsum("qk,qki->qi", share, self.translation[index]))


def _of(readings: TimedPoses | TimedRotations) -> _Smooth:
    time_s = readings.time_s
    stretch = np.concatenate([[0], np.cumsum(np.diff(time_s) > readings.max_gap_s)])
    samples: RigidTransform | Rotation = readings.world_from_sensor
    if isinstance(samples, Rotation):
        return _Smooth(_Parabolas(time_s, stretch), samples, None)
    return _Smooth(_Parabolas(time_s, stretch), samples.rotation, np.asarray(samples.translation))


class SmoothPoses(TimedPoses):
    """Poses that are read from local parabolas."""

    @cached_property
    def _smooth(self) -> _Smooth:
        return _of(self)

    def at(self, times_s: npt.ArrayLike) -> RigidTransform:
        """Pose at each of `times_s`; raises as `TimedPoses.at` does."""
        times = self.require_covered(times_s)
        return RigidTransform.from_components(self._smooth.moved(times), self._smooth.turned(times))


class SmoothRotations(TimedRotations):
    """Rotations that are read from local parabolas."""

    @cached_property
    def _smooth(self) -> _Smooth:
        return _of(self)

    def at(self, times_s: npt.ArrayLike) -> Rotation:
        """Rotation at each of `times_s`; raises as `TimedRotations.at` does."""
        return self._smooth.turned(self.require_covered(times_s))


@overload
def smooth(readings: TimedPoses) -> SmoothPoses: ...
@overload
def smooth(readings: TimedRotations) -> SmoothRotations: ...
def smooth(readings: TimedPoses | TimedRotations) -> SmoothPoses | SmoothRotations:
    """Read the same samples from local parabolas.

    The weights of the samples are Gaussian in time. Their width is what predicts samples from their
    neighbours best: wide where noise is large, narrow where the motion is fast.

    Parameters
    ----------
    readings : TimedPoses or TimedRotations
        At least three samples.
    """
    if isinstance(readings, TimedPoses):
        return SmoothPoses(readings.time_s, readings.world_from_sensor, readings.max_gap_s)
    return SmoothRotations(readings.time_s, readings.world_from_sensor, readings.max_gap_s)
