"""The sensor's own orientation, however it is written and in whatever world, as ``world_from_sensor``.

The world is x magnetic north, y west, z up (NWU). Quaternions are scalar first and take the sensor's axes to
the world's; angles are roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError

GRAVITY_M_S2 = 9.80665

WORLDS = {
    "NWU": Rotation.identity(),
    "ENU": Rotation.from_euler("z", -90.0, degrees=True),
    "NED": Rotation.from_euler("x", 180.0, degrees=True),
}
"""``nwu_from_world`` of each world that the sensors know."""

_WORST_NORM = 0.05
"""How far a quaternion's length may be from 1, and a matrix's rows from square: far beyond rounding in any
number format (1e-6), far below what damage does."""

_WORST_ANGLE_DEG = 720.0

_AT_REST_M_S2 = 0.5
"""How far from gravity an acceleration may be and still show where up is."""

_CLEARLY_BETTER = 0.5


@dataclass(frozen=True)
class Orientations:
    """Orientation of samples, some of which may have none.

    Attributes
    ----------
    world_from_sensor : Rotation, length m
        The identity where `there` is false.
    there : ndarray of bool, shape (m,)
    """

    world_from_sensor: Rotation
    there: BoolArray


def nwu_from(world: str) -> Rotation:
    """Rotation from a world by name; raises `InvalidInputError` if there is none of that name."""
    if world.upper() not in WORLDS:
        raise InvalidInputError(f"world: expected {', '.join(WORLDS)}, got {world!r}")
    return WORLDS[world.upper()]


def from_quaternions(wxyz: FloatArray, world: str) -> Orientations:
    """Of quaternions, shape (m, 4); those that are not of unit length count as missing."""
    there = np.asarray(np.abs(_length(wxyz) - 1.0) < _WORST_NORM)
    usable = wxyz if there.all() else np.where(there[:, None], wxyz, [1.0, 0.0, 0.0, 0.0])
    return _seen_from_north(usable, there, world)


def from_angles(roll_pitch_yaw_deg: FloatArray, world: str) -> Orientations:
    """Of angles in degrees, shape (m, 3)."""
    there = np.asarray((np.abs(roll_pitch_yaw_deg) <= _WORST_ANGLE_DEG).all(axis=1))
    usable = np.where(there[:, None], roll_pitch_yaw_deg, 0.0)
    quaternions = Rotation.from_euler("xyz", usable, degrees=True).as_quat(scalar_first=True)
    return _seen_from_north(quaternions, there, world)


def from_matrices(matrices: FloatArray, world: str) -> Orientations:
    """Of matrices, shape (m, 3, 3); those that are not rotations count as missing."""
    there = are_rotations(matrices)
    usable = np.where(there[:, None, None], matrices, np.eye(3))
    return _seen_from_north(Rotation.from_matrix(usable).as_quat(scalar_first=True), there, world)


def are_rotations(matrices: FloatArray) -> BoolArray:
    """Which of the matrices, shape (m, 3, 3), have square rows of length 1 and are right-handed."""
    finite = np.where(np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None, None] < 2.0, matrices, 0.0)
    off = np.abs(np.einsum("mij,mkj->mik", finite, finite) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return np.asarray((off < _WORST_NORM) & (np.linalg.det(finite) > 0.0))


def rows_or_columns(matrices: FloatArray, accelerometer_m_s2: FloatArray | None) -> tuple[FloatArray, bool]:
    """The matrices or their transposes, whichever turn the acceleration at rest to straight up.

    Returns
    -------
    ndarray, shape (m, 3, 3)
    bool
        Whether they were transposed. Without samples that tell, they are not.
    """
    if accelerometer_m_s2 is None:
        return matrices, False
    rest = np.abs(_length(accelerometer_m_s2) - GRAVITY_M_S2) < _AT_REST_M_S2
    rest &= are_rotations(matrices)
    as_is, turned = (
        np.linalg.norm(
            np.einsum(how, matrices[rest], accelerometer_m_s2[rest]) - [0, 0, GRAVITY_M_S2], axis=1
        )
        for how in ("mij,mj->mi", "mji,mj->mi")
    )
    if rest.any() and np.median(turned) < _CLEARLY_BETTER * np.median(as_is):
        return np.swapaxes(matrices, 1, 2), True
    return matrices, False


def _length(vectors: FloatArray) -> FloatArray:
    with np.errstate(over="ignore"):
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def _seen_from_north(wxyz: FloatArray, there: BoolArray, world: str) -> Orientations:
    """The rotations after that from `world`; as one product of matrices, many times faster than SciPy's."""
    w, x, y, z = nwu_from(world).as_quat(scalar_first=True)
    product = np.array([[x, w, -z, y], [y, z, w, -x], [z, -y, x, w], [w, -x, -y, -z]])
    xyzw = np.einsum("ij,mj->mi", product, wxyz)
    if not there.all():
        xyzw[~there] = [0.0, 0.0, 0.0, 1.0]
    return Orientations(Rotation.from_quat(xyzw), there)
