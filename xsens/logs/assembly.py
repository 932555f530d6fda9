"""Samples as sent, from all readers of logs, to an `ImuLog`, and the sensor's own orientation to NWU.

The orientation may be in any notation and world; NWU is x north, y west, z up. Turned into its world, the
acceleration shows whether z is up (ENU, NWU) or down (NED), and the field's horizontal part whether north is
y (ENU) or x (NWU, NED). They are a median and a mean of directions, so that movement and iron nearby may
disturb some samples. The dip of the field has no part in it: it points up in the south.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps, timeline
from xsens.logs.faults import without_faults
from xsens.logs.samples import ImuLog, median, row_norms

WORLDS = {
    "NWU": Rotation.identity(),
    "ENU": Rotation.from_euler("z", -90.0, degrees=True),
    "NED": Rotation.from_euler("x", 180.0, degrees=True),
}
"""``nwu_from_world`` of each world that the sensors know."""

_WORST_NORM = 0.05
"""How far a quaternion's length may be from 1, and a matrix's rows from orthonormal: far beyond rounding in
any number format (1e-6), far below the effect of damage."""

_WORST_ANGLE_DEG = 720.0

_FEWEST = 8
"""Samples that tell a world."""

_AT_REST = 0.05
"""Share of its median by which the acceleration's length may differ in samples that are preferred."""

_SURE_DEG, _BETTER = 1.0, 1.5
"""Tilt of the acceleration at rest, turned into the world, that proves nothing, and how many times less it
must be in another notation than in the usual one. Of 18 logs of BROAD, MT Manager, Xsens and Clarius none has
less tilt if its scalar is taken for the last number; written so that it is, 15 have 1.5 to 35 times less."""

_UPRIGHT = 0.87
"""Smallest vertical part of the median acceleration: 30 degrees, above what steady movement makes of it."""

_STEADY = 0.5
"""Shortest mean of the field's horizontal unit vectors that tells a direction: drift scatters them."""

_NORTH_DEG = 30.0
"""A field within this of a world's north belongs to it: declinations where people live are less."""

_EVIDENCE = {"NWU": (1.0, 0.0), "ENU": (1.0, 90.0), "NED": (-1.0, 0.0)}
"""Direction of the acceleration along z, and degrees from x to north, in each world."""


class Claim(NamedTuple):
    """World named, and by whom in words.

    `final` if nothing outweighs it; `by_default` if nobody said so, which is always noted.
    """

    world: str
    by: str
    final: bool = False
    by_default: bool = False


@dataclass(frozen=True)
class Hints:
    """Facts known beside the log; each outweighs what the log says.

    Attributes
    ----------
    rate_hz : float, optional
        Samples per second, for logs with a counter but no clock.
    world : str, optional
        Of the sensor's own orientation, ENU, NED or NWU.
    as_stated : bool
        Take the world that the log states or its program's default, whatever its readings show: too few
        samples of a live stream show nothing.

    Raises
    ------
    InvalidInputError
        If no sensor has such a rate, or there is no such world.
    """

    rate_hz: float | None = None
    world: str | None = None
    as_stated: bool = False

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 1e-3 <= self.rate_hz <= 1e5:
            raise InvalidInputError(f"rate_hz: expected 0.001 to 100000, got {self.rate_hz:g}")
        if self.world is not None and self.world.upper() not in WORLDS:
            raise InvalidInputError(f"world: expected {', '.join(WORLDS)}, got {self.world!r}")


@dataclass(frozen=True)
class Parts:
    """Samples as they were sent, one row for each message or line.

    Attributes
    ----------
    stamps : Stamps
    vectors : mapping of str to ndarray, shape (m, 3)
        Readings by the names in `VECTORS`.
    notations : mapping of str to ndarray, shape (m, 4)
        The sensor's own orientation, as `to_nwu` has it.
    claim : Claim, optional
        Its world; None for one that has nothing to do with north and up.
    increments : mapping of str to ndarray, shape (m, 3)
        Of velocity, and rotation vectors, over each sampling period, by the names of their rates.
    """

    stamps: Stamps
    vectors: Mapping[str, FloatArray]
    notations: Mapping[str, FloatArray]
    claim: Claim | None
    notes: tuple[str, ...]
    increments: Mapping[str, FloatArray]


def assemble_log(parts: Parts, hints: Hints, source: str) -> ImuLog:
    """Build the log of samples, without those that are no measurements.

    Raises
    ------
    InvalidInputError
        If they have neither a clock, nor a rate; if orientation and acceleration contradict each other; or if
        they are of several sensors.
    """
    stamps, vectors = parts.stamps, {**parts.increments, **parts.vectors}
    if hints.rate_hz is not None:
        stamps = replace(stamps, period_s=1.0 / hints.rate_hz)
    scaled = [name for name in parts.increments if name not in parts.vectors]
    notes = [*parts.notes, *(f"{name.split('_')[0]}: increments over the sampling period" for name in scaled)]
    line = timeline(stamps, [*vectors.values(), *parts.notations.values()])
    notations = {meaning: wxyz[line.rows] for meaning, wxyz in parts.notations.items()}
    wxyz = next(iter(notations.values()), np.zeros((0, 4)))
    oriented = np.isfinite(wxyz[:, 0])
    if missing := (~oriented).sum():
        notes.append(f"{missing} samples lack the sensor's own orientation")
    rotations = Rotation.from_quat(np.where(oriented[:, None], wxyz, 0.5), scalar_first=True)
    columns: dict[str, Any] = {name: part[line.rows] for name, part in vectors.items()}
    log = ImuLog(
        line.time_s,
        **columns,
        world_from_sensor=rotations if oriented.any() else None,
        counter=line.counter,
        gaps=line.gaps,
        notes=(*notes, *line.notes),
        source=source,
        oriented=oriented,
    )
    log = without_faults(replace(log, **{name: columns[name] * log.rate_hz for name in scaled}))
    if log.world_from_sensor is None:
        return log
    claim = parts.claim if hints.world is None else Claim(hints.world.upper(), "as given", final=True)
    return to_nwu(log, notations, claim, hints.as_stated)


# -- notations


def quaternions_of(numbers: FloatArray) -> FloatArray:
    """Quaternions, scalar first, NaN where the numbers are damage.

    Parameters
    ----------
    numbers : ndarray, shape (m, 4), (m, 9) or (m, 3)
        Quaternions; matrices row by row; or roll, pitch and yaw in degrees, R = Rz(yaw) Ry(pitch) Rx(roll).
    """
    if numbers.shape[1] == 4:
        return np.where((np.abs(row_norms(numbers) - 1.0) < _WORST_NORM)[:, None], numbers, np.nan)
    if numbers.shape[1] == 3:
        good = (np.abs(numbers) <= _WORST_ANGLE_DEG).all(axis=1)
        turns = Rotation.from_euler("xyz", numbers[good], degrees=True)
    else:
        good = are_rotations(numbers)
        turns = Rotation.from_matrix(numbers[good].reshape(-1, 3, 3))
    wxyz = np.full((good.size, 4), np.nan)
    wxyz[good] = turns.as_quat(scalar_first=True)
    return wxyz


def are_rotations(numbers: FloatArray) -> Any:
    """Mark the matrices, shape (m, 9), that have orthonormal rows and are right-handed."""
    matrices = np.where(np.abs(numbers) < 2.0, numbers, 0.0).reshape(-1, 3, 3)
    off = np.abs(matrices @ matrices.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return (off < _WORST_NORM) & (np.linalg.det(matrices) > 0.0)


def rotation_vectors(wxyz: FloatArray) -> FloatArray:
    """Rotation vectors of quaternions, NaN of those that are damage."""
    good = np.isfinite(quaternions_of(wxyz)[:, :1])
    turns = Rotation.from_quat(np.where(good, wxyz, 1.0), scalar_first=True)
    return np.where(good, turns.as_rotvec(), np.nan)


# -- worlds


def to_nwu(
    log: ImuLog, notations: Mapping[str, FloatArray], claim: Claim | None, as_stated: bool = False
) -> ImuLog:
    """The log with the sensor's own orientation in NWU, and notes on it.

    Parameters
    ----------
    log : ImuLog
        Without what is no measurement; `oriented` where it has an orientation.
    notations : mapping of str to ndarray, shape (m, 4)
        Orientations of its samples, scalar first, by what their numbers may mean; the usual first.
    claim : Claim, optional
        Their world; None for one that has nothing to do with north and up.
    as_stated : bool
        Take the world that is claimed, whatever the readings show.

    Raises
    ------
    InvalidInputError
        If acceleration and orientation contradict each other, unless the claim is final.
    """
    ups = {meaning: _up(log, wxyz) for meaning, wxyz in notations.items()}
    meaning = _likelier(ups)
    wxyz = np.where(log.oriented[:, None], notations[meaning], 0.5)
    notes = [f"orientation: {meaning}, by its own accelerometer"] if meaning else []
    world = "NWU" if claim is None else claim.world
    if claim is not None and not as_stated:
        world, note = _world_of(claim, ups[meaning], _north_deg(_in_world(log, wxyz, log.magnetometer_au)))
        notes += filter(None, [note])
    rotations = WORLDS[world] * Rotation.from_quat(wxyz, scalar_first=True)
    return replace(log, world_from_sensor=rotations, notes=(*log.notes, *notes))


def _likelier(ups: Mapping[str, FloatArray]) -> str:
    """Notation in which the acceleration at rest is vertical; the first unless another surely is."""
    first = next(iter(ups))
    if not ups[first].size:
        return first
    tilts_deg = {
        meaning: np.hypot(np.degrees(np.arccos(min(np.percentile(np.abs(up), 10), 1.0))), _SURE_DEG)
        for meaning, up in ups.items()
    }
    best = min(tilts_deg, key=tilts_deg.__getitem__)
    return best if tilts_deg[first] > _BETTER * tilts_deg[best] else first


def _up(log: ImuLog, wxyz: FloatArray) -> Any:
    """Vertical parts of the accelerations' directions at rest, in the orientations' world, shape (n,)."""
    vectors = _in_world(log, wxyz, log.accelerometer_m_s2)
    length = row_norms(vectors)
    calm = np.abs(length - median(length)) < _AT_REST * median(length)
    calm |= calm.sum() < _FEWEST
    return vectors[calm, 2] / length[calm]


def _world_of(claim: Claim, ups: FloatArray, north_deg: float) -> tuple[str, str]:
    """World of the orientations by what the readings say of it, and a note on it, perhaps empty."""
    world = claim.world
    if not ups.size:
        note = f"orientation: taken as {world}, {claim.by}: no accelerometer's reading tells"
        return world, note if claim.by_default else ""
    up = median(ups)
    if abs(up) < _UPRIGHT:
        tilt = np.degrees(np.arccos(up))
        off = f"the orientation turns the accelerometer's reading {tilt:.0f} degrees from the vertical"
        if claim.final:
            return world, f"orientation: {world}, {claim.by}, although {off}"
        raise InvalidInputError(f"expected an orientation in ENU, NWU or NED, but {off}: give --world")
    likely = [name for name in (world, *WORLDS) if _EVIDENCE[name][0] * up > 0.0]
    by_north = [name for name in likely if abs(north_deg - _EVIDENCE[name][1]) <= _NORTH_DEG]
    evident, sensors = (by_north or likely)[0], "its own accelerometer alone"
    if by_north:
        sensors = "its own accelerometer and magnetometer"
    elif np.isfinite(north_deg):
        sensors = f"its own accelerometer, while the magnetometer has north {north_deg:.0f} degrees from x"
    chosen = world if claim.final else evident
    if world == evident and (by_north or not (claim.by_default or np.isfinite(north_deg))):
        return chosen, ""
    return chosen, f"orientation: {chosen} ({claim.by}: {world}; by {sensors}: {evident}); --world decides"


def _north_deg(fields: FloatArray) -> float:
    """Direction from x towards y of the horizontal part of fields in the world; NaN if they have none."""
    if not fields.size:
        return np.nan
    x, y = (fields[:, :2] / np.maximum(row_norms(fields[:, :2]), 1e-12)[:, None]).mean(axis=0)
    return np.degrees(np.arctan2(y, x)) if np.hypot(x, y) > _STEADY else np.nan


def _in_world(log: ImuLog, wxyz: FloatArray, vectors: FloatArray | None) -> FloatArray:
    """Readings turned into the world, shape (n, 3); none if they are too few."""
    part = np.flatnonzero(log.oriented)
    if vectors is not None:
        part = part[row_norms(vectors[part]) > 0.0]
    if vectors is None or len(part) < _FEWEST:
        return np.empty((0, 3))
    return Rotation.from_quat(wxyz[part], scalar_first=True).apply(vectors[part])
