"""A sensor's samples on its own clock, validated once, interpolated on demand."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import require_increasing

DEFAULT_MAX_GAP_S = 0.2
"""Longest pause between two samples that interpolation bridges: five frames at 25 frames/s, about the time
in which a hand's motion is still smooth (physiological tremor is at 4-12 Hz)."""


@dataclass(frozen=True)
class _Clock:
    """Sample times, and which other times may be interpolated between them."""

    time_s: FloatArray
    max_gap_s: float

    def covers(self, times_s: npt.ArrayLike) -> BoolArray:
        t = np.asarray(times_s, dtype=float)
        right = np.clip(np.searchsorted(self.time_s, t), 1, max(self.time_s.size - 1, 1))
        if self.time_s.size < 2:
            return np.isin(t, self.time_s)
        before, after = self.time_s[right - 1], self.time_s[right]
        inside = (t >= before) & (t <= after) & (after - before <= self.max_gap_s)
        return np.asarray(inside | np.isin(t, self.time_s))

    def require(self, times_s: npt.ArrayLike) -> FloatArray:
        t = np.asarray(times_s, dtype=float)
        missing = np.flatnonzero(~np.atleast_1d(self.covers(t)))
        if missing.size:
            raise InsufficientDataError(
                f"sensor samples do not cover time {np.atleast_1d(t)[missing[0]]:.4f} s "
                f"({missing.size} of {t.size} asked times): samples span "
                f"{self.time_s[0]:.4f} to {self.time_s[-1]:.4f} s, "
                f"gaps over {self.max_gap_s:g} s are not bridged"
            )
        return t


class _Timed:
    """Samples on a clock: validation and coverage, shared by rotations and poses."""

    time_s: FloatArray
    max_gap_s: float
    _clock: _Clock

    def _settle(self, samples: int) -> None:
        """Validate the times and the number of samples."""
        object.__setattr__(self, "time_s", require_increasing(self.time_s, "time_s"))
        if self.time_s.size != samples:
            raise InvalidInputError(
                f"expected as many samples as times, got {samples} and {self.time_s.size}"
            )
        if samples == 0:
            raise InvalidInputError("expected at least one sensor sample, got none")
        object.__setattr__(self, "_clock", _Clock(self.time_s, self.max_gap_s))

    def __len__(self) -> int:
        return int(self.time_s.size)

    def covers(self, times_s: npt.ArrayLike) -> BoolArray:
        """Whether each of `times_s` lies on a sample or between two that are close enough."""
        return self._clock.covers(times_s)


@dataclass(frozen=True)
class TimedRotations(_Timed):
    """Orientation samples of one sensor.

    Parameters
    ----------
    time_s : ndarray, shape (m,)
        The sensor's clock, strictly increasing.
    world_from_sensor : Rotation, length m
    max_gap_s : float
        The longest pause that `at` interpolates across.
    """

    time_s: FloatArray
    world_from_sensor: Rotation
    max_gap_s: float = DEFAULT_MAX_GAP_S
    _clock: _Clock = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._settle(len(self.world_from_sensor))

    def at(self, times_s: npt.ArrayLike) -> Rotation:
        """Orientation at `times_s` by spherical linear interpolation.

        Raises
        ------
        InsufficientDataError
            If a time is outside the samples or in a gap longer than `max_gap_s`.
        """
        t = self._clock.require(times_s)
        if len(self) == 1:
            return self.world_from_sensor[np.zeros(t.shape, dtype=int)]
        return self._slerp(t)

    @cached_property
    def _slerp(self) -> Slerp:
        return Slerp(self.time_s, self.world_from_sensor)


@dataclass(frozen=True)
class TimedPoses(_Timed):
    """Position and orientation samples of one sensor.

    Parameters
    ----------
    time_s : ndarray, shape (m,)
        The sensor's clock, strictly increasing.
    world_from_sensor : RigidTransform, length m
        Translation in mm.
    max_gap_s : float
        The longest pause that `at` interpolates across.
    """

    time_s: FloatArray
    world_from_sensor: RigidTransform
    max_gap_s: float = DEFAULT_MAX_GAP_S
    _clock: _Clock = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._settle(len(self.world_from_sensor))

    def at(self, times_s: npt.ArrayLike) -> RigidTransform:
        """Pose at `times_s`: slerp of the rotation, linear interpolation of the translation.

        Raises
        ------
        InsufficientDataError
            If a time is outside the samples or in a gap longer than `max_gap_s`.
        """
        t = self._clock.require(times_s)
        if len(self) == 1:
            return self.world_from_sensor[np.zeros(t.shape, dtype=int)]
        translation, slerp = self._paths
        moved = np.stack([np.interp(t, self.time_s, column) for column in translation.T], axis=-1)
        return RigidTransform.from_components(moved, slerp(t))

    @cached_property
    def _paths(self) -> tuple[FloatArray, Slerp]:
        translation, rotation = self.world_from_sensor.as_components()
        return np.asarray(translation), Slerp(self.time_s, rotation)
