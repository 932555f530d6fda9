"""A sensor's samples on its own clock, validated once, interpolated on demand."""

from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import require_increasing
from speckle3d.core.text import shown

DEFAULT_MAX_GAP_S = 0.2
"""Longest pause between two samples that interpolation bridges: five frames at 25 frames/s, about the time
in which a hand's motion is still smooth (physiological tremor is at 4-12 Hz)."""

Samples = TypeVar("Samples", Rotation, RigidTransform)


@dataclass(frozen=True)
class TimedSamples(Generic[Samples]):
    """Samples on a clock: validation, coverage and lookup, whatever the samples are."""

    time_s: FloatArray
    world_from_sensor: Samples
    max_gap_s: float = DEFAULT_MAX_GAP_S

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", require_increasing(self.time_s, "time_s"))
        if not 0 < self.time_s.size == len(self.world_from_sensor):
            raise InvalidInputError(
                f"expected samples with times, got {len(self.world_from_sensor)} and {self.time_s.size}"
            )

    def __len__(self) -> int:
        return int(self.time_s.size)

    def covers(self, times_s: npt.ArrayLike) -> BoolArray:
        """Whether each of `times_s` lies on a sample or between two that are close enough."""
        t = np.asarray(times_s, dtype=float)
        before, after = np.searchsorted(self.time_s, t), np.searchsorted(self.time_s, t, "right")
        gap_s = np.pad(np.diff(self.time_s), 1, constant_values=np.inf)
        return np.asarray((before != after) | (gap_s[before] <= self.max_gap_s))

    def at(self, times_s: npt.ArrayLike) -> Samples:
        """Sample at each of `times_s`: slerp of the rotation, linear interpolation of the translation.

        Raises
        ------
        InsufficientDataError
            If a time is outside the samples or in a gap longer than `max_gap_s`.
        """
        t, samples = self.require_covered(times_s), self.world_from_sensor
        if len(self) == 1:
            return samples[np.zeros(t.shape, dtype=int)]
        if not isinstance(samples, RigidTransform):
            return self._slerp(t)
        moved = np.stack([np.interp(t, self.time_s, column) for column in samples.translation.T], axis=-1)
        return RigidTransform.from_components(moved, self._slerp(t))

    def require_covered(self, times_s: npt.ArrayLike) -> FloatArray:
        """Return `times_s` as an array if `at` can read them.

        Raises
        ------
        InsufficientDataError
            If a time is outside the samples or in a gap longer than `max_gap_s`.
        """
        t = np.asarray(times_s, dtype=float)
        missing = np.flatnonzero(~self.covers(t))
        if missing.size:
            raise InsufficientDataError(
                f"sensor samples do not cover time {t.flat[missing[0]]:.4f} s and {missing.size - 1} others: "
                f"they span {self.time_s[0]:.4f} to {self.time_s[-1]:.4f} s, {self.max_gap_s:g} s bridged"
            )
        return t

    @cached_property
    def _slerp(self) -> Slerp:
        samples = self.world_from_sensor
        return Slerp(self.time_s, samples.rotation if isinstance(samples, RigidTransform) else samples)


@shown
@dataclass(frozen=True)
class TimedRotations(TimedSamples[Rotation]):
    """Orientation samples of one sensor.

    Parameters
    ----------
    time_s : ndarray, shape (m,)
        The sensor's clock, strictly increasing.
    world_from_sensor : Rotation, length m
    max_gap_s : float
        The longest pause that `at` interpolates across.

    Examples
    --------
    >>> readings = TimedRotations(np.array([0.0, 0.1]), Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.2]]))
    >>> readings.at(0.05).as_rotvec().round(3).tolist()
    [0.0, 0.0, 0.1]
    """


@shown
@dataclass(frozen=True)
class TimedPoses(TimedSamples[RigidTransform]):
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
