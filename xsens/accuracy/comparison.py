"""Compare two streams of orientation by total angle, heading and inclination."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedRotations

if TYPE_CHECKING:
    from xsens.fusion.orient import Orientation


@dataclass(frozen=True)
class Comparison:
    """Differences of one stream from another.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Times of the first stream's samples that the second covers.
    total_rad, heading_rad, inclination_rad : ndarray, shape (m,)
        The whole angle, the signed angle about up, and the angle that remains without it (Laidig et al.
        2021); a constant heading offset is included.
    heading_offset_rad : float
        Mean difference in heading.
    """

    time_s: FloatArray
    total_rad: FloatArray
    heading_rad: FloatArray
    inclination_rad: FloatArray
    heading_offset_rad: float

    @property
    def total_rms_rad(self) -> float:
        """Root mean square of the whole angle."""
        return _rms(self.total_rad)

    @property
    def heading_rms_rad(self) -> float:
        """Root mean square of the heading's difference."""
        return _rms(self.heading_rad)

    @property
    def heading_rms_without_offset_rad(self) -> float:
        """Root mean square of the heading's difference less its mean."""
        off = np.angle(np.exp(1j * (self.heading_rad - self.heading_offset_rad)))
        return _rms(off)

    @property
    def inclination_rms_rad(self) -> float:
        """Root mean square of the inclination's difference."""
        return _rms(self.inclination_rad)


def compare_orientations(
    one: TimedRotations | Orientation, other: TimedRotations | Orientation
) -> Comparison:
    """Compare two streams on one clock, for example the sensor's own orientation with the filter's.

    Parameters
    ----------
    one, other : TimedRotations or Orientation
        In worlds whose z is up; `other` is interpolated at the samples of `one`.

    Raises
    ------
    InsufficientDataError
        If they have no time in common.
    InvalidInputError
        If one is no stream of orientation.

    References
    ----------
    .. [1] D. Laidig et al., "BROAD - A benchmark for robust inertial orientation estimation", Data 6(7),
    2021.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from xsens import TimedRotations, compare_orientations
    >>> time_s = np.array([0.0, 0.1, 0.2])
    >>> level = TimedRotations(time_s, Rotation.identity(3))
    >>> turned = TimedRotations(time_s, Rotation.from_euler("z", np.full((3, 1), 0.1)))
    >>> found = compare_orientations(turned, level)
    >>> round(found.heading_rms_rad, 6), round(found.inclination_rms_rad, 6)
    (0.1, 0.0)
    """
    one, other = _stream(one), _stream(other)
    common = other.covers(one.time_s)
    if not common.any():
        raise InsufficientDataError(
            f"expected streams that overlap, got {one.time_s[0]:.3f} to {one.time_s[-1]:.3f} s "
            f"and {other.time_s[0]:.3f} to {other.time_s[-1]:.3f} s"
        )
    time_s = one.time_s[common]
    apart = one.world_from_sensor[common] * other.at(time_s).inv()
    w, x, y, z = apart.as_quat(scalar_first=True).T
    heading = np.angle(np.exp(2j * np.arctan2(z, w)))
    inclination = 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))
    total = 2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w))
    offset = float(np.angle(np.exp(1j * heading).mean()))
    return Comparison(time_s, total, heading, inclination, offset)


def _stream(given: object) -> TimedRotations:
    stream = getattr(given, "rotations", given)
    if not isinstance(stream, TimedRotations):
        raise InvalidInputError(
            f"expected TimedRotations or an Orientation, as orient(log) gives, got {type(given).__name__}: "
            "a log's own orientation is log.rotations()"
        )
    return stream


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
