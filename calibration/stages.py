"""Where to start: the angles of a plane calibration from line directions alone, then the distances.

Both stages are linear once the plane's normal is assumed, so that no guess of the mounting is needed and no
local minimum is met; normals are tried all over the hemisphere.

References
----------
.. [1] Prager et al., CUED/F-INFENG/TR 303, 1997, appendix A (the stages; they are iterative there).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.chain import Chain, ImagePoints
from speckle3d.core.geometry import FloatArray

_NORMALS = 120
"""Directions over the hemisphere, 13 degrees apart: refinement converges from twice as far."""

_REWEIGHTINGS = 4


@dataclass(frozen=True)
class Angles:
    """A start for the angles.

    Attributes
    ----------
    ratio : float
        Column pitch over row spacing.
    cost : float
        Median absolute sine of the angle between line and plane.
    """

    sensor_from_image: Rotation
    normal: FloatArray
    ratio: float
    cost: float


def hemisphere(count: int = _NORMALS) -> FloatArray:
    """Unit vectors spread evenly over the hemisphere z >= 0, the pole first, shape (count, 3)."""
    k = np.arange(count)
    z = 1.0 - k / count
    around = k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    return np.column_stack([flat * np.cos(around), flat * np.sin(around), z])


def angle_starts(
    directions_px: FloatArray,
    world_from_sensor: Rotation,
    ratio: float | None,
    normals: FloatArray,
    keep: int = 2,
) -> list[Angles]:
    """Find angles from line directions, best first.

    Parameters
    ----------
    directions_px : ndarray, shape (m, 2)
        Columns and rows from one end of each line to the other.
    world_from_sensor : Rotation, length m
    ratio : float, optional
        Column pitch over row spacing; estimated without it.
    normals : ndarray, shape (k, 3)
        Normals of the plane to try.
    """
    length = directions_px * [1.0 if ratio is None else ratio, 1.0]
    flat = length / np.linalg.norm(length, axis=1, keepdims=True)
    up = np.einsum("ki,nij->knj", normals, world_from_sensor.as_matrix())
    axes = _image_axes(flat, up)
    found = [_angles(flat, up[k], normals[k], axes[k], ratio) for k in range(len(normals))]
    return sorted(found, key=lambda start: start.cost)[:keep]


def _image_axes(flat: FloatArray, up: FloatArray) -> FloatArray:
    """Image axes x and y in the sensor's frame for each assumed normal, up to scale, shape (k, 6).

    To them every line's condition, ``(d_x x + d_y y) . up = 0``, is linear.
    """
    rows = np.concatenate([flat[:, :1] * up, flat[:, 1:] * up], axis=2)
    weights = np.ones(rows.shape[:2])
    for _ in range(_REWEIGHTINGS):
        axes = np.linalg.eigh(np.swapaxes(rows * weights[:, :, None], 1, 2) @ rows)[1][:, :, 0]
        misfit = np.abs(np.einsum("kni,ki->kn", rows, axes))
        weights = 1.0 / np.maximum(misfit, np.median(misfit, axis=1, keepdims=True) + 1e-12)
    return axes


def _angles(
    flat: FloatArray, up: FloatArray, normal: FloatArray, axes: FloatArray, ratio: float | None
) -> Angles:
    lengths = np.linalg.norm(axes.reshape(2, 3), axis=1)
    seen = 1.0 if ratio is not None else float(lengths[0] / max(lengths[1], 1e-12))
    rotation = _from_axes(axes[:3], axes[3:])
    straight = flat * [seen, 1.0]
    straight /= np.linalg.norm(straight, axis=1, keepdims=True)
    sines = np.einsum("ni,ni->n", up, straight @ rotation.as_matrix()[:, :2].T)
    return Angles(rotation, normal, seen if ratio is None else ratio, float(np.median(np.abs(sines))))


def _from_axes(x: FloatArray, y: FloatArray) -> Rotation:
    """Nearest rotation to image axes x and y that need not be square."""
    unit = np.column_stack([x / np.linalg.norm(x), y / np.linalg.norm(y)])
    left, _, right = np.linalg.svd(unit, full_matrices=False)
    u, v = (left @ right).T
    return Rotation.from_matrix(np.column_stack([u, v, np.cross(u, v)]))


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
    found, misfit = _least_absolute(unknown, wanted)
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


def _least_absolute(matrix: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Linear solution whose outliers pull little (reweighted least squares towards least absolute values)."""
    weights = np.ones(len(wanted))
    for _ in range(_REWEIGHTINGS):
        found = np.linalg.lstsq(weights[:, None] * matrix, weights * wanted, rcond=None)[0]
        misfit = matrix @ found - wanted
        weights = 1.0 / np.sqrt(np.maximum(np.abs(misfit), np.median(np.abs(misfit)) + 1e-9))
    return found, misfit
