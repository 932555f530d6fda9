"""First stage of a plane's calibration: angles from line directions, whatever the mounting.

A line of the plane lies in it, wherever the plane is: the plane's normal is square to the line's direction
(TR 303, appendix A). Mountings are tried all over, and the best of them are refined side by side.

References
----------
.. [1] R. W. Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997.
.. [2] M. Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", CVPR, 2022.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError

_NORMALS, _ROTATIONS = 30, 800
"""About 26 and 30 degrees apart: refinement converges from further away."""
_REFINED, _KEPT = 12, 3
_ROUNDS = 20
_HOPELESS = 3.0
"""Ends whose mean absolute residual is as many times the least are not looked at again."""
_SAME_RAD = np.deg2rad(5.0)
_DAMPING = 1e-3
_TINY = 1e-12


@dataclass(frozen=True)
class Angles:
    """A mounting and a plane, without distances.

    Attributes
    ----------
    ratio : float
        Column pitch over row spacing.
    sensor_from_image : Rotation
    normal : ndarray, shape (3,)
        Of the plane, in the world.
    """

    ratio: float
    sensor_from_image: Rotation
    normal: FloatArray


def hemisphere() -> FloatArray:
    """Unit vectors spread evenly over the hemisphere z >= 0, the pole first, shape (30, 3)."""
    k = np.arange(_NORMALS)
    z = 1.0 - k / _NORMALS
    around = k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    return np.column_stack([flat * np.cos(around), flat * np.sin(around), z])


def rotations_all_over() -> Rotation:
    """Rotations spread evenly over the whole rotation group, [2]_."""
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


def angle_starts(
    directions_px: FloatArray,
    turns: FloatArray,
    ratio: float,
    normals: FloatArray,
    fit_ratio: bool = False,
    level: bool = False,
) -> list[Angles]:
    """Find the angles that make line directions lie in a plane, robustly; the best first.

    Parameters
    ----------
    directions_px : ndarray, shape (m, 2)
        Columns and rows from one end of each line to the other.
    turns : ndarray, shape (m, 3, 3)
        ``world_from_sensor``, rotation matrices.
    ratio : float
        Column pitch over row spacing, to begin with where it is fitted too.
    normals : ndarray, shape (k, 3)
        Of the plane, tried first.
    level : bool
        The normal stays what it is.

    Raises
    ------
    InsufficientDataError
        If directions are not finite.
    """
    if not np.isfinite(directions_px).all():
        raise InsufficientDataError("expected line directions that are finite, got others")
    length = np.linalg.norm(directions_px * [ratio, 1.0], axis=1)
    unit = directions_px / length[:, None]  # of length one once the columns are scaled
    tried = rotations_all_over()
    # Half a turn about z leaves the directions of lines as they are.
    tried = tried[tried.as_matrix()[:, 0, 0] >= 0]
    up = np.einsum("ki,nij->knj", normals, turns)
    sines = np.einsum("kni,jia,na->jkn", up, tried.as_matrix()[:, :, :2], unit * [ratio, 1.0], optimize=True)
    costs = np.abs(sines).mean(axis=2)
    mounting, plane = np.unravel_index(np.argsort(costs, axis=None)[:_REFINED], costs.shape)
    probe, normal = tried[mounting].as_matrix(), normals[plane].astype(float)
    ratios = np.full(len(probe), ratio)
    for _ in range(_ROUNDS):
        _step(unit, turns, ratios, probe, normal, fit_ratio, level)
    left = np.abs(_sines(unit, turns, ratios, probe, normal)[0]).mean(axis=1)
    return _distinct(left, ratios, probe, normal)


def _sines(
    unit: FloatArray, turns: FloatArray, ratios: FloatArray, probe: FloatArray, normal: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sines between lines and plane, (k, m), the normal in the image, (k, m, 3), and the lines in it."""
    seen = np.einsum("ki,nij->knj", normal, turns) @ probe
    along = unit * np.stack([ratios, np.ones_like(ratios)], axis=1)[:, None]
    return np.sum(seen[..., :2] * along, axis=2), seen, along


def _step(
    unit: FloatArray,
    turns: FloatArray,
    ratios: FloatArray,
    probe: FloatArray,
    normal: FloatArray,
    fit_ratio: bool,
    level: bool,
) -> None:
    """One step of least absolute sines, by reweighting, from each start; in place."""
    sines, seen, along = _sines(unit, turns, ratios, probe, normal)
    (x, y), (a, b, c) = np.moveaxis(along, 2, 0), np.moveaxis(seen, 2, 0)
    columns = [y * c, -x * c, x * b - y * a]
    _, _, axes = np.linalg.svd(normal[:, None])
    tangents = axes[:, 1:]
    if not level:
        world = np.einsum("nij,kja,kna->kni", turns, probe[:, :, :2], along)
        columns += list(np.einsum("kni,kti->tkn", world, tangents))
    if fit_ratio:
        columns.append(a * x)
    matrix = np.stack(columns, axis=2)
    size = np.abs(sines)
    weight = 1.0 / np.maximum(size, 0.1 * np.median(size, axis=1, keepdims=True) + _TINY)
    weighted = matrix * weight[..., None]
    system = np.swapaxes(weighted, 1, 2) @ matrix
    lift = _DAMPING * np.einsum("kii->ki", system) + _TINY
    system += lift[:, :, None] * np.eye(len(columns))
    step = -np.linalg.solve(system, np.einsum("knp,kn->kp", weighted, sines)[..., None])[..., 0]
    step = np.clip(step, -0.5, 0.5)
    probe[:] = probe @ Rotation.from_rotvec(step[:, :3]).as_matrix()
    if not level:
        normal += np.einsum("kt,kti->ki", step[:, 3:5], tangents)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    if fit_ratio:
        ratios *= np.exp(step[:, -1])


def _distinct(left: FloatArray, ratios: FloatArray, probe: FloatArray, normal: FloatArray) -> list[Angles]:
    """Ends that are not one answer, the one that leaves least first, and none that leaves far more."""
    turns, kept = Rotation.from_matrix(probe), list[int]()
    for k in np.argsort(left):
        away = [
            min(step.magnitude(), in_plane_mirror(step).magnitude())
            for step in (turns[j].inv() * turns[int(k)] for j in kept)
        ]
        if left[k] <= _HOPELESS * left.min() + _TINY and all(one > _SAME_RAD for one in away):
            kept.append(int(k))
    return [Angles(float(ratios[k]), turns[k], normal[k]) for k in kept[:_KEPT]]
