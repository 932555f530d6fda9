"""Rotations and directions all over, the in-plane mirror: what first guesses are made from.

References
----------
.. [1] M. Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", CVPR, 2022.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray

_NORMALS, _ROTATIONS = 30, 800
"""About 26 and 30 degrees apart: refinement converges from further away."""


def hemisphere() -> FloatArray:
    """Unit vectors spread evenly over the hemisphere z >= 0, the pole first, shape (30, 3)."""
    k = np.arange(_NORMALS)
    z = 1.0 - k / _NORMALS
    around = k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    return np.column_stack([flat * np.cos(around), flat * np.sin(around), z])


def rotations_all_over() -> Rotation:
    """Rotations spread evenly over the whole rotation group, [1]_."""
    s = np.arange(_ROTATIONS) + 0.5
    first, second = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    inner, outer = np.sqrt(s / _ROTATIONS), np.sqrt(1.0 - s / _ROTATIONS)
    parts = (inner * np.sin(first), inner * np.cos(first), outer * np.sin(second), outer * np.cos(second))
    return Rotation.from_quat(np.column_stack(parts))


def in_plane_mirror(rotation: Rotation) -> Rotation:
    """The other rotation that explains the same line directions: half a turn in the image plane."""
    return rotation * Rotation.from_euler("z", np.pi)


def rotation_to_z(normal: FloatArray) -> Rotation:
    """A rotation that turns a plane's normal into the z axis."""
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [normal])[0]
