"""The sensor's own orientation, in any notation and world, as rotations to north, west and up (NWU).

Turned into its world, the acceleration shows whether z is up (ENU, NWU) or down (NED), and the field's
horizontal part whether north is y (ENU) or x (NWU, NED). Both are medians, so that movement and iron nearby
may disturb some samples. The dip of the field has no part in it: it points up in the south.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError

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

_CLEARLY_LESS = 0.25
"""Ratio of what misses to upright, by which columns must be better than rows: half the angle."""

_FEWEST, _MOST = 8, 20_000
"""Samples that tell a world, and that are looked at: medians of more are no better."""

_AT_REST = 0.05
"""Share of its median by which the acceleration's length may differ in samples that are preferred."""

_UPRIGHT = 0.87
"""Smallest vertical part of the median acceleration: 30 degrees, above what steady movement makes of it."""

_STEADY = 0.5
"""Shortest mean of the field's horizontal unit vectors that tells a direction: drift scatters them."""

_NORTH_DEG = 30.0
"""A field within this of a world's north belongs to it: declinations where people live are less."""

_DECLINATION_DEG = 10.0
"""A smaller difference is the sensor's own error, or iron nearby."""


@dataclass(frozen=True)
class Claim:
    """World named, and by whom in words.

    `final` if nothing outweighs it; `assumed` if nobody said so, which is always noted.
    """

    world: str
    by: str
    final: bool = False
    assumed: bool = False


def nwu_from(world: str) -> Rotation:
    """Rotation from a world by name; raises `InvalidInputError` if there is none of that name."""
    if world.upper() not in WORLDS:
        raise InvalidInputError(f"world: expected {', '.join(WORLDS)}, got {world!r}")
    return WORLDS[world.upper()]


# -- notations


def quaternions_of(
    numbers: FloatArray, acceleration: FloatArray | None
) -> tuple[FloatArray, tuple[str, ...]]:
    """Quaternions, scalar first, NaN where the numbers are damage, and notes.

    Parameters
    ----------
    numbers : ndarray, shape (m, 4), (m, 9) or (m, 3)
        Quaternions; matrices row after row, or column after column if the acceleration shows that; or roll,
        pitch and yaw in degrees, R = Rz(yaw) Ry(pitch) Rx(roll).
    acceleration : ndarray, shape (m, 3), optional
    """
    if numbers.shape[1] == 4:
        with np.errstate(over="ignore", invalid="ignore"):
            off = np.abs(np.sqrt(np.einsum("ij,ij->i", numbers, numbers)) - 1.0)
        return np.where((off < _WORST_NORM)[:, None], numbers, np.nan), ()
    if numbers.shape[1] == 3:
        good = np.asarray((np.abs(numbers) <= _WORST_ANGLE_DEG).all(axis=1))
        return _where(good, Rotation.from_euler("xyz", numbers[good], degrees=True)), ()
    rows = numbers.reshape(-1, 3, 3)
    by_rows, by_columns = (_of_matrices(each) for each in (rows, rows.swapaxes(1, 2)))
    missing = [1.0 - abs(upright_part(each, acceleration) or 0.0) for each in (by_rows, by_columns)]
    if missing[1] < _CLEARLY_LESS * missing[0]:
        return by_columns, ("matrices were taken by columns: so they turn gravity upright",)
    return by_rows, ()


def are_rotations(matrices: FloatArray) -> BoolArray:
    """Mark the matrices, shape (m, 3, 3), that have orthonormal rows and are right-handed."""
    finite = np.where(np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None, None] < 2.0, matrices, 0.0)
    off = np.abs(np.einsum("mij,mkj->mik", finite, finite) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return np.asarray((off < _WORST_NORM) & (np.linalg.det(finite) > 0.0))


def _of_matrices(matrices: FloatArray) -> FloatArray:
    good = are_rotations(matrices)
    return _where(good, Rotation.from_matrix(matrices[good]))


def _where(good: BoolArray, turns: Rotation) -> FloatArray:
    """Quaternions of those rotations, NaN elsewhere."""
    wxyz = np.full((good.size, 4), np.nan)
    wxyz[good] = turns.as_quat(scalar_first=True)
    return wxyz


def seen_from_north(wxyz: FloatArray, world: str) -> tuple[Rotation, BoolArray]:
    """``nwu_from_world`` times the rotations, the identity where there is none; and where there is one."""
    there = np.asarray(np.isfinite(wxyz).all(axis=1))
    turns = Rotation.from_quat(np.where(there[:, None], wxyz, [1.0, 0.0, 0.0, 0.0]), scalar_first=True)
    xyzw = (nwu_from(world) * turns).as_quat()
    xyzw[~there] = [0.0, 0.0, 0.0, 1.0]
    return Rotation.from_quat(xyzw), there


# -- worlds


def world_of(
    claim: Claim, wxyz: FloatArray, acceleration: FloatArray | None, field: FloatArray | None
) -> tuple[str, tuple[str, ...]]:
    """World of the orientations by what the readings say of it, and notes on it.

    Parameters
    ----------
    claim : Claim
    wxyz : ndarray, shape (m, 4)
        Orientations in the world in question, scalar first; NaN where missing.
    acceleration, field : ndarray, shape (m, 3), or None

    Raises
    ------
    InvalidInputError
        If acceleration and orientation contradict each other, unless the claim is final.
    """
    taken, north_deg = claim.world.upper(), _north_deg(wxyz, field)
    up = upright_part(wxyz, acceleration)
    if up is None:
        note = f"orientation: taken as {taken}, {claim.by}: no accelerometer's reading tells"
        return taken, ((note,) if claim.assumed else ())
    if abs(up) < _UPRIGHT:
        tilt = np.degrees(np.arccos(up))
        off = f"the orientation turns the accelerometer's reading {tilt:.0f} degrees from the vertical"
        if claim.final:
            return taken, (f"orientation: {taken}, {claim.by}, although {off}",)
        raise InvalidInputError(f"expected an orientation in ENU, NWU or NED, but {off}: give --world")
    shown = _shown(up > 0.0, north_deg, taken)
    sensors = "accelerometer" if np.isnan(north_deg) else "accelerometer and magnetometer"
    world, notes = taken if claim.final else shown, []
    if world != shown:
        notes.append(f"orientation: {world}, {claim.by}; by its own {sensors} it is {shown}")
    elif world != taken:
        notes.append(f"orientation: {world} by its own {sensors}, not {taken}, {claim.by}")
    elif claim.assumed and np.isnan(north_deg):
        notes.append(f"orientation: taken as {world}, {claim.by}: no steady field tells; see --world")
    elif claim.assumed:
        notes.append(f"orientation: {world} by its own {sensors}")
    west = _apart(north_deg, 90.0 if world == "ENU" else 0.0) * (1.0 if world == "NED" else -1.0)
    if abs(west) > _DECLINATION_DEG:
        side = "west" if west > 0.0 else "east"
        notes.append(f"the sensor's own north is {abs(west):.0f} degrees {side} of its field's")
    return world, tuple(notes)


def upright_part(wxyz: FloatArray, acceleration: FloatArray | None) -> float | None:
    """Vertical part of the median acceleration, at rest if there is any, over its length; None without."""
    vectors = _turned(wxyz, acceleration)
    if vectors is None:
        return None
    length = np.linalg.norm(vectors, axis=1)
    rest = np.abs(length - np.median(length)) < _AT_REST * np.median(length)
    return float(np.median(vectors[rest if rest.sum() >= _FEWEST else slice(None), 2]) / np.median(length))


def _north_deg(wxyz: FloatArray, field: FloatArray | None) -> float:
    """Direction of the field's horizontal part from x towards y; NaN if it has none."""
    vectors = _turned(wxyz, field)
    if vectors is None:
        return float("nan")
    along = vectors[:, :2] / np.maximum(np.hypot(vectors[:, 0], vectors[:, 1]), 1e-12)[:, None]
    if np.hypot(*along.mean(axis=0)) < _STEADY:
        return float("nan")
    x, y = np.median(along, axis=0)
    return float(np.degrees(np.arctan2(y, x)))


def _turned(wxyz: FloatArray, vectors: FloatArray | None) -> FloatArray | None:
    """Readings turned into the world, shape (n, 3), of some thousand samples; None if there are too few."""
    if vectors is None:
        return None
    known = np.flatnonzero(np.isfinite(wxyz[:, 0]))
    some = known[:: len(known) // _MOST + 1]
    wxyz, vectors = wxyz[some], vectors[some]
    there = (np.abs(vectors) < 1e6).all(axis=1) & (vectors != 0.0).any(axis=1)
    if there.sum() < _FEWEST:
        return None
    return Rotation.from_quat(wxyz[there], scalar_first=True).apply(vectors[there])


def _shown(z_is_up: bool, north_deg: float, taken: str) -> str:
    """World that the readings show; where they leave a choice, the one taken."""
    if not z_is_up:
        return "NED"
    for world, axis_deg in (("NWU", 0.0), ("ENU", 90.0)):
        if abs(_apart(north_deg, axis_deg)) <= _NORTH_DEG:
            return world
    return taken if taken != "NED" else "NWU"


def _apart(degrees: float, others: float) -> float:
    return (degrees - others + 180.0) % 360.0 - 180.0
