"""`ImuLog`: samples of one sensor on its own clock, whatever file they were read from.

The world of an orientation is x magnetic north, y west, z up (the MT9-B's own, NWU), whatever frame the
sensor was set to.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.geometry import require_increasing
from speckle3d.core.streams import TimedRotations as TimedRotations
from speckle3d.core.text import shown

VECTORS = ("accelerometer_m_s2", "gyroscope_rad_s", "magnetometer_au")

_PAUSE = 2.5
"""A clock step of more periods is a pause, not jitter."""


def finite_rows(rows: FloatArray) -> BoolArray:
    """Mark the rows of three finite numbers; many times faster than a reduction over a few columns."""
    return np.isfinite(rows[:, 0]) & np.isfinite(rows[:, 1]) & np.isfinite(rows[:, 2])


def row_norms(rows: FloatArray) -> FloatArray:
    """Length of each row, whatever damage it holds; several times faster where columns are contiguous."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", rows, rows)))


def median(values: FloatArray, none: float = np.nan) -> Any:
    """Median of the finite numbers, or `none` without any; several times faster than NumPy's."""
    values = values[np.isfinite(values)]
    half = values.size // 2
    if not values.size:
        return none
    values = np.partition(values, half)
    return values[half] if values.size % 2 else 0.5 * (values[:half].max() + values[half])


def median_norm(rows: FloatArray) -> Any:
    """Median length of the rows that have one; NaN if none has."""
    return median(row_norms(rows))


@dataclass(frozen=True)
class Gap:
    """A pause between two samples in which samples were lost.

    Attributes
    ----------
    after_index : int
        Index of the last sample before the pause.
    lost : int
        Number of missing samples; 0 if only the pause is known.
    duration_s : float
        From the last sample before the pause to the first after it.
    """

    after_index: int
    lost: int
    duration_s: float


@shown
@dataclass(frozen=True)
class ImuLog:
    """Samples of one sensor on its own clock.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Strictly increasing.
    accelerometer_m_s2, gyroscope_rad_s, magnetometer_au : ndarray, shape (m, 3), optional
        In the sensor's axes; a row is NaN where that sample lacks it. The field is in arbitrary units, about
        1 where the sensor was calibrated.
    world_from_sensor : Rotation, length m, optional
        The sensor's own orientation; meaningless where `oriented` is false.
    counter : ndarray of int, shape (m,), optional
        The sensor's own count, made to rise beyond its word length.
    gaps : tuple of Gap
        In order of time; found from the counter or the clock.
    notes : tuple of str
        What was skipped, assumed, or not compensated.
    source : str
        Name of the file or stream.
    oriented : ndarray of bool, shape (m,), optional
        True where a sample has the sensor's own orientation; by default everywhere, or nowhere without
        `world_from_sensor`.

    Raises
    ------
    InvalidInputError
        If the clock does not rise or there is no sample.
    MismatchError
        If the lengths differ.

    Examples
    --------
    >>> import numpy as np
    >>> from xsens import ImuLog
    >>> log = ImuLog(np.arange(5) / 100.0, gyroscope_rad_s=np.zeros((5, 3)))
    >>> len(log), log.rate_hz, log.lost
    (5, 100.0, 0)
    """

    time_s: FloatArray
    accelerometer_m_s2: FloatArray | None = None
    gyroscope_rad_s: FloatArray | None = None
    magnetometer_au: FloatArray | None = None
    world_from_sensor: Rotation | None = None
    counter: IntArray | None = None
    gaps: tuple[Gap, ...] = ()
    notes: tuple[str, ...] = ()
    source: str = ""
    oriented: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", require_increasing(self.time_s, "time_s"))
        if self.time_s.size == 0:
            raise InvalidInputError(f"{self.source or 'log'}: expected at least one sample, got none")
        if self.oriented.size == 0:
            object.__setattr__(self, "oriented", np.full(len(self), self.world_from_sensor is not None))
        tails = dict.fromkeys(VECTORS, (3,)) | dict.fromkeys(("oriented", "counter", "world_from_sensor"), ())
        for name, tail in tails.items():
            values, expected = getattr(self, name), (len(self), *tail)
            if values is not None and (shape := (len(values), *np.shape(values)[1:])) != expected:
                raise MismatchError(f"{name}: expected shape {expected}, got {shape}")

    def __len__(self) -> int:
        return int(self.time_s.size)

    @cached_property
    def rate_hz(self) -> float:
        """Samples per second, lost ones included, as the sensor took them; NaN for a single sample."""
        steps = np.diff(self.time_s)
        regular = steps < _PAUSE * median(steps)
        regular[[gap.after_index for gap in self.gaps]] = False
        return float(1.0 / (steps[regular].mean() if regular.any() else median(steps)))

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def lost(self) -> int:
        """Number of samples known to be missing."""
        return sum(gap.lost for gap in self.gaps)

    @property
    def losses(self) -> str:
        """Number and length of the gaps in words; empty if there are none."""
        if not self.gaps:
            return ""
        longest_s = max(gap.duration_s for gap in self.gaps)
        gaps = (
            f"{self.lost} samples lost in {len(self.gaps)} gaps" if self.lost else f"{len(self.gaps)} pauses"
        )
        return f"{gaps}, the longest of {longest_s:.3f} s"

    @property
    def own_direction(self) -> FloatArray | None:
        """A direction that rests in the world, seen from the sensor by its own orientation, shape (m, 3).

        NaN where it has none; None without any.
        """
        if self.world_from_sensor is None:
            return None
        oblique = self.world_from_sensor.inv().apply([1.0, 1.0, 1.0])
        return np.where(self.oriented[:, None], oblique, np.nan)

    def rotations(self) -> TimedRotations:
        """The sensor's own orientation as a stream of the samples that have it.

        Raises
        ------
        InsufficientDataError
            If no sample has it.
        """
        if self.world_from_sensor is None or not self.oriented.any():
            raise InsufficientDataError(
                f"{self.source or 'log'}: expected samples with the sensor's own orientation, got none"
            )
        return TimedRotations(self.time_s[self.oriented], self.world_from_sensor[self.oriented])
