"""Compare two streams of orientation by total angle, heading and inclination."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.streams import TimedRotations
from xsens.accuracy.angles import span

if TYPE_CHECKING:
    from xsens.fusion.orient import Orientation


@dataclass(frozen=True)
class Comparison:
    """Root mean squares of one stream's difference from another, as in [1]_.

    Attributes
    ----------
    total_rms_rad, heading_rms_rad, inclination_rms_rad : float
        Of the whole angle, of the signed angle about up, and of the angle that remains without it.
    heading_offset_rad, heading_rms_without_offset_rad : float
        Mean difference in heading, and the root mean square of what is left without it.

    References
    ----------
    .. [1] D. Laidig et al., "BROAD - A benchmark for robust inertial orientation estimation", Data 6(7),
       2021.
    """

    total_rms_rad: float
    heading_rms_rad: float
    inclination_rms_rad: float
    heading_offset_rad: float
    heading_rms_without_offset_rad: float


def compare_orientations(
    one: TimedRotations | Orientation, other: TimedRotations | Orientation
) -> Comparison:
    """Compare two streams on one clock, for example the sensor's own orientation with the filter's.

    Parameters
    ----------
    one, other : TimedRotations or Orientation
        In worlds whose z is up; `other` is interpolated at the samples of `one`.

    Returns
    -------
    Comparison
        What sets the two apart, degrees.

    Raises
    ------
    InsufficientDataError
        If they have no time in common.
    InvalidInputError
        If one is no stream of orientation.

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
    first, second = (s if isinstance(s, TimedRotations) else s.rotations for s in (one, other))
    common = second.covers(first.time_s)
    if not common.any():
        raise InsufficientDataError(
            f"expected streams that overlap, got {span(first.time_s)} and {span(second.time_s)}"
        )
    apart = first.world_from_sensor[common] * second.at(first.time_s[common]).inv()
    w, x, y, z = apart.as_quat(scalar_first=True).T
    turn = np.exp(2j * np.arctan2(z, w))
    offset = turn.mean()
    return Comparison(
        _rms(apart.magnitude()),
        _rms(np.angle(turn)),
        _rms(2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))),
        float(np.angle(offset)),
        _rms(np.angle(turn / offset)),
    )


def _rms(values: npt.ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
