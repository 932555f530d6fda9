"""Where to start: the angles of a plane calibration from line directions alone, then the distances.

Mountings are tried all over, so that no guess is needed and no local minimum is met; the distances are then
linear.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, appendix A (the stages; they are iterative there).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import Chain, ImagePoints
from speckle3d.core.arrays import FloatArray

_NORMALS = 30
_ROTATIONS = 800
"""About 26 and 30 degrees apart: refinement converges from further away."""

_REWEIGHTINGS = 4


@dataclass(frozen=True)
class Angles:
    """A start for the angles.

    Attributes
    ----------
    ratio : float
        Column pitch over row spacing.
    """

    sensor_from_image: Rotation
    normal: FloatArray
    ratio: float


def hemisphere(count: int = _NORMALS) -> FloatArray:
    """Unit vectors spread evenly over the hemisphere z >= 0, the pole first, shape (count, 3)."""
    k = np.arange(count)
    z = 1.0 - k / count
    around = k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    return np.column_stack([flat * np.cos(around), flat * np.sin(around), z])


def rotations_all_over() -> Rotation:
    """Rotations spread evenly over all there are.

    References
    ----------
    .. [1] M. Alexa, "Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3)", CVPR, 2022.
    """
    s = np.arange(_ROTATIONS) + 0.5
    t = s / _ROTATIONS
    first, second = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    inner, outer = np.sqrt(t), np.sqrt(1.0 - t)
    parts = (inner * np.sin(first), inner * np.cos(first), outer * np.sin(second), outer * np.cos(second))
    return Rotation.from_quat(np.column_stack(parts))


def angle_starts(
    directions_px: FloatArray, world_from_sensor: Rotation, ratio: float, normals: FloatArray, keep: int = 4
) -> list[Angles]:
    """Try mountings of the sensor and normals of the plane all over, and keep the best.

    Parameters
    ----------
    directions_px : ndarray, shape (m, 2)
        Columns and rows from one end of each line to the other.
    world_from_sensor : Rotation, length m
    ratio : float
        Column pitch over row spacing.
    normals : ndarray, shape (k, 3)
    """
    length = directions_px * [ratio, 1.0]
    flat = length / np.linalg.norm(length, axis=1, keepdims=True)
    up = np.einsum("ki,nij->knj", normals, world_from_sensor.as_matrix())
    tried = rotations_all_over()
    # Half a turn about z leaves the directions of lines as they are.
    tried = tried[tried.as_matrix()[:, 0, 0] >= 0]
    axes = tried.as_matrix()[:, :, :2]
    # Mean absolute sine of the angle between line and plane: wrong lines pull little.
    sines = np.einsum("kni,jia,na->jkn", up, axes, flat, optimize=True)
    costs = np.abs(sines).mean(axis=2)
    best = np.argsort(costs, axis=None)[:keep]
    return [
        Angles(tried[int(j)], normals[k], ratio)
        for j, k in zip(*np.unravel_index(best, costs.shape), strict=True)
    ]


def in_plane_mirror(rotation: Rotation) -> Rotation:
    """The other rotation that explains the same line directions: half a turn in the image plane."""
    return rotation * Rotation.from_euler("z", np.pi)


def distance_start(points: ImagePoints, angles: Angles, pixel_mm: FloatArray | None) -> tuple[Chain, float]:
    """Find the distances that belong to given angles, by linear least squares.

    Parameters
    ----------
    pixel_mm : ndarray, shape (2,), optional
        Column pitch and row spacing; estimated without it, from the ratio in `angles`.

    Returns
    -------
    chain : Chain
    cost : float
        Median absolute height of the points above the plane, mm.
    """
    shift, turn = points.world_from_sensor.as_components()
    up = angles.normal @ turn.as_matrix()
    square = np.array([angles.ratio, 1.0]) if pixel_mm is None else pixel_mm
    image = (points.pixels * square) @ angles.sensor_from_image.as_matrix()[:, :2].T
    height = np.einsum("ni,ni->n", up, image)
    one = np.ones((len(points), 1))
    unknown = np.concatenate([up, one] if pixel_mm is not None else [up, one, height[:, None]], axis=1)
    wanted = -shift @ angles.normal - (height if pixel_mm is not None else 0.0)
    found, misfit = least_absolute(unknown, wanted)
    size = square * (1.0 if pixel_mm is not None else found[4])
    turned = angles.sensor_from_image
    if size[1] < 0:
        turned, size = in_plane_mirror(turned), -size
    target = Rotation.align_vectors([[0.0, 0.0, 1.0]], [angles.normal])[0]
    chain = Chain(
        size,
        RigidTransform.from_components(found[:3], turned),
        RigidTransform.from_components([0.0, 0.0, found[3]], target),
    )
    return chain, float(np.median(np.abs(misfit)))


def least_absolute(matrix: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Linear solution whose outliers pull little (reweighted least squares towards least absolute values)."""
    weights = np.ones(len(wanted))
    for _ in range(_REWEIGHTINGS):
        found = np.linalg.lstsq(weights[:, None] * matrix, weights * wanted, rcond=None)[0]
        misfit = matrix @ found - wanted
        weights = 1.0 / np.sqrt(np.maximum(np.abs(misfit), np.median(np.abs(misfit)) + 1e-9))
    return np.asarray(found), misfit
