"""Which world an orientation is seen from, by the sensor's own accelerometer and magnetometer.

Turned into its world, the acceleration shows whether z is up (ENU, NWU) or down (NED), and the field's
horizontal part whether north is y (ENU) or x (NWU, NED). Both are medians, so that movement and iron nearby
may disturb some samples. The dip of the field has no part in it: it points up in the south.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

WORLDS = {
    "NWU": Rotation.identity(),
    "ENU": Rotation.from_euler("z", -90.0, degrees=True),
    "NED": Rotation.from_euler("x", 180.0, degrees=True),
}
"""``nwu_from_world`` of each world that the sensors know."""

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


def turned(turn: Rotation, wxyz: FloatArray) -> FloatArray:
    """One rotation times quaternions, shape (m, 4), scalar first; the product is scalar last.

    One product of matrices: many times faster than SciPy's.
    """
    w, x, y, z = turn.as_quat(scalar_first=True)
    product = np.array([[x, w, -z, y], [y, z, w, -x], [z, -y, x, w], [w, -x, -y, -z]])
    return np.asarray(np.einsum("ij,mj->mi", product, wxyz))


def settle(
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
    taken = claim.world.upper()
    up = upright_part(wxyz, acceleration)
    if up is None:
        note = f"orientation: taken as {taken}, {claim.by}: no accelerometer's reading tells"
        return taken, ((note,) if claim.assumed else ())
    if abs(up) < _UPRIGHT:
        tilt = np.degrees(np.arccos(up))
        found = f"the orientation turns the accelerometer's reading {tilt:.0f} degrees from the vertical"
        if claim.final:
            return taken, (f"orientation: {taken}, {claim.by}, although {found}",)
        raise InvalidInputError(f"expected an orientation in ENU, NWU or NED, but {found}: give --world")
    north_deg = _north_deg(wxyz, field)
    shown = _shown(up > 0.0, north_deg, taken)
    world = taken if claim.final else shown
    return world, tuple(_notes(claim, world, shown, north_deg))


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
    some = slice(None, None, len(wxyz) // _MOST + 1)
    wxyz, vectors = wxyz[some], vectors[some]
    there = np.isfinite(wxyz).all(axis=1) & (np.abs(vectors) < 1e6).all(axis=1) & (vectors != 0.0).any(axis=1)
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


def _notes(claim: Claim, world: str, shown: str, north_deg: float) -> list[str]:
    """What was taken for the world and why, and where its x is not north."""
    notes, taken = [], claim.world.upper()
    told = "accelerometer" if np.isnan(north_deg) else "accelerometer and magnetometer"
    if world != shown:
        notes.append(f"orientation: {world}, {claim.by}; by its own {told} it is {shown}")
    elif world != taken:
        notes.append(f"orientation: {world} by its own {told}, not {taken}, {claim.by}")
    elif claim.assumed and np.isnan(north_deg):
        notes.append(f"orientation: taken as {world}, {claim.by}: no steady field tells; see --world")
    elif claim.assumed:
        notes.append(f"orientation: {world} by its own {told}")
    east = _apart(north_deg, 90.0 if world == "ENU" else 0.0) * (-1.0 if world == "NED" else 1.0)
    if abs(east) > _DECLINATION_DEG:
        side = "east" if east > 0.0 else "west"
        why = "as by a declination" if abs(east) <= _NORTH_DEG else "as by a heading reset: it is not north"
        notes.append(f"the sensor's own north is {abs(east):.0f} degrees {side} of its field's, {why}")
    return notes
