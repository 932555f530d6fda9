"""Oblique planes, sized to what a sweep shows of them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.cuts.outlines import crossings, frame_outlines
from speckle3d.imaging.cuts.planes import Cut, plane_cut

_LEAST_SINE = 1e-4
"""Of the angle between two directions that span a plane: six thousandths of a degree."""


def spanned_plane(origin_mm: npt.ArrayLike, right: npt.ArrayLike, down: npt.ArrayLike) -> RigidTransform:
    """Place a plane by its origin, the direction of its rows and one on the side of its columns.

    Raises
    ------
    InvalidInputError
        If a direction has no length, both are along one line, or the origin is not finite.
    """
    vectors = np.array([origin_mm, right, down], dtype=float)
    with np.errstate(invalid="ignore"):
        x, y = vectors[1:] / np.linalg.norm(vectors[1:], axis=1, keepdims=True)
    normal = np.cross(x, y)
    sine = np.linalg.norm(normal)
    if not (sine >= _LEAST_SINE and np.isfinite(vectors[0]).all()):
        words = " and ".join(map(vector_words, vectors))
        raise InvalidInputError(f"plane: expected an origin and two directions that span it, got {words}")
    axes = Rotation.from_matrix(np.column_stack([x, np.cross(normal / sine, x), normal / sine]))
    return RigidTransform.from_components(vectors[0], axes)


def turned_frame_plane(
    world_from_image: RigidTransform, lateral_mm: float, angle_deg: float
) -> RigidTransform:
    """Place a plane in one frame's depth line, turned about it: at 90 degrees along the sweep."""
    line = RigidTransform.from_translation([lateral_mm, 0.0, 0.0])
    # Turned by -y, so that x goes from lateral to elevational.
    turn = RigidTransform.from_rotation(Rotation.from_euler("Y", -angle_deg, degrees=True))
    return world_from_image * line * turn


def covering_plane(
    world_from_plane: RigidTransform,
    grid: ImageGrid,
    world_from_image: RigidTransform,
    reach_mm: float,
    pixel_mm: float,
) -> Cut:
    """Plane placed anywhere, as large as what the sweep's frames show of it.

    Parameters
    ----------
    world_from_plane : RigidTransform, single
        Its x and y are the plane; the picture's axes count from its origin.
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    reach_mm : float
        Frames farther from a pixel do not count.
    pixel_mm : float

    Raises
    ------
    InvalidInputError
        If no frame comes near the plane; says where the sweep is.
    """
    outlines = frame_outlines(grid, world_from_image)
    corners = world_from_plane.inv().apply(outlines.reshape(-1, 3))
    away = np.abs(corners[:, 2])
    lines = crossings(outlines, world_from_plane).reshape(-1, 2)
    points = np.concatenate([corners[away <= reach_mm, :2], lines[np.isfinite(lines[:, 0])]])
    if not len(points):
        low, high = outlines.min(axis=(0, 1)), outlines.max(axis=(0, 1))
        raise InvalidInputError(
            f"plane: expected one that meets a frame within {reach_mm:g} mm, all between {vector_words(low)} "
            f"and {vector_words(high)} mm, got one {away.min():.1f} mm from there"
        )
    return plane_cut(world_from_plane, points.min(axis=0), points.max(axis=0), pixel_mm)


def vector_words(vector: Iterable[float]) -> str:
    """Text of a vector for messages."""
    return "(" + ", ".join(f"{value:.4g}" for value in vector) + ")"
