"""Planes to cut along that are placed anywhere, and as large as what a sweep or a volume shows of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.cuts.outlines import crossings, frame_outlines
from speckle3d.imaging.cuts.planes import DEFAULT_PIXEL_MM, ReslicePlane, plane_around

_LEAST_SINE = 1e-4
"""Of the angle between two directions that span a plane: six thousandths of a degree."""


def three_point_plane(points_mm: npt.ArrayLike) -> RigidTransform:
    """Place a plane through three points: x from the first to the second, y on the third's side.

    Raises
    ------
    InvalidInputError
        If they are not three, or lie on one line.
    """
    points = np.asarray(points_mm, dtype=float)
    if points.shape != (3, 3) or not np.isfinite(points).all():
        raise InvalidInputError(f"points: expected three of x, y, z in mm, got shape {points.shape}")
    first, second, third = points
    return spanned_plane(first, second - first, third - first, "three points that are not on one line")


def spanned_plane(
    origin_mm: npt.ArrayLike,
    right: npt.ArrayLike,
    down: npt.ArrayLike,
    expected: str = "two directions that span a plane",
) -> RigidTransform:
    """Place a plane by its origin, the direction of its rows and one on the side of its columns.

    Raises
    ------
    InvalidInputError
        If a direction has no length, both are along one line, or the origin is not finite.
    """
    if not np.isfinite(origin_mm).all():
        raise InvalidInputError(f"plane: expected a finite origin, got {vector_words(np.asarray(origin_mm))}")
    x, y = (np.asarray(each, dtype=float) for each in (right, down))
    lengths = [float(np.linalg.norm(each)) for each in (x, y)]
    got = f"got directions {vector_words(x)} and {vector_words(y)}"
    if min(lengths) == 0 or not np.isfinite(lengths).all():
        raise InvalidInputError(f"plane: expected {expected}, {got}")
    x, y = x / lengths[0], y / lengths[1]
    across = y - (y @ x) * x
    if np.linalg.norm(across) < _LEAST_SINE:
        raise InvalidInputError(f"plane: expected {expected}, {got}")
    y = across / np.linalg.norm(across)
    turned = Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)]))
    return RigidTransform.from_components(np.asarray(origin_mm, dtype=float), turned)


def turned_frame_plane(
    world_from_image: RigidTransform, lateral_mm: float, angle_deg: float
) -> RigidTransform:
    """Place a plane in one frame's depth line, turned about it: at 90 degrees along the sweep.

    Raises
    ------
    InvalidInputError
        If the angle is not finite.
    """
    if not np.isfinite(angle_deg):
        raise InvalidInputError(f"angle_deg: expected a finite angle, got {angle_deg}")
    line = RigidTransform.from_translation([lateral_mm, 0.0, 0.0])
    # Turned by -y, so that x goes from lateral to elevational.
    turn = RigidTransform.from_rotation(Rotation.from_euler("Y", -angle_deg, degrees=True))
    return world_from_image * line * turn


def covering_plane(
    placed: RigidTransform,
    grid: ImageGrid,
    world_from_image: RigidTransform,
    reach_mm: float,
    pixel_mm: float = DEFAULT_PIXEL_MM,
) -> ReslicePlane:
    """Plane placed anywhere, as large as what the sweep's frames show of it.

    Parameters
    ----------
    placed : RigidTransform, single
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
    corners = placed.inv().apply(outlines[:, :4].reshape(-1, 3))
    near = corners[np.abs(corners[:, 2]) < reach_mm, :2]
    ends = crossings(outlines, placed).reshape(-1, 2)
    points = np.concatenate([near, ends[np.isfinite(ends[:, 0])]])
    if not len(points):
        low, high = outlines.min(axis=(0, 1)), outlines.max(axis=(0, 1))
        away = float(np.abs(corners[:, 2]).min())
        raise InvalidInputError(
            f"plane: expected one that meets a frame within {reach_mm:g} mm, got one {away:.1f} mm from the "
            f"nearest; the sweep lies between {vector_words(low)} and {vector_words(high)} mm"
        )
    return plane_around(placed, points, pixel_mm)


def covering_box(placed: RigidTransform, corners_mm: FloatArray, pixel_mm: float) -> ReslicePlane:
    """Plane placed anywhere, as large as its section of a box.

    Parameters
    ----------
    placed : RigidTransform, single
        Its x and y are the plane; the picture's axes count from its origin.
    corners_mm : ndarray, shape (8, 3)
        The box's, in the order of `itertools.product`, in the world.
    pixel_mm : float

    Raises
    ------
    InvalidInputError
        If the plane misses the box; says where that is.
    """
    there = placed.inv().apply(corners_mm)
    edges = np.array([(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit])
    start, stop = there[edges[:, 0]], there[edges[:, 1]]
    near = np.abs(there[:, 2]) <= 1e-6 * np.ptp(there, axis=0).max()
    crossed = start[:, 2] * stop[:, 2] < 0
    share = start[crossed, 2] / (start[crossed, 2] - stop[crossed, 2])
    points = np.concatenate([there[near], start[crossed] + share[:, None] * (stop - start)[crossed]])[:, :2]
    if not len(points):
        low, high = corners_mm.min(axis=0), corners_mm.max(axis=0)
        raise InvalidInputError(
            f"plane: expected one that meets the volume, which lies between {vector_words(low)} and "
            f"{vector_words(high)} mm, got one {np.abs(there[:, 2]).min():.1f} mm from it"
        )
    return plane_around(placed, points, pixel_mm)


def vector_words(vector: FloatArray) -> str:
    """Text of a vector for messages."""
    return "(" + ", ".join(f"{each:.4g}" for each in vector) + ")"
