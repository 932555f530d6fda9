"""Assign points to frames, the two on either side as reslices blend them, and poses' errors to points.

A point moves with the frames it belongs to, as with rigid bodies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.poses import PoseErrors

REACH_MM = 0.5
"""Points no farther from the sweep than this are taken to be in it."""
_AT_ONCE = 2**20
"""Points times frames worked on at a time: some 40 MB."""


class Belonging(NamedTuple):
    """Two frames for each point, with interpolation weights that sum to one.

    Attributes
    ----------
    frames : ndarray of int, shape (k, 2)
    weights : ndarray, shape (k, 2)
    gap_mm : ndarray, shape (k,)
        Distance to the nearer frame's image; of points between two frames, within its plane.
    """

    frames: IntArray
    weights: FloatArray
    gap_mm: FloatArray

    def of_points(self, rows: IntArray) -> Belonging:
        """Frames and weights of a subset of the points."""
        return Belonging(self.frames[rows], self.weights[rows], self.gap_mm[rows])


def belonging_of(points_mm: FloatArray, grid: ImageGrid, world_from_image: RigidTransform) -> Belonging:
    """Find the frame nearest to each point, and its neighbour on the point's other side.

    Nearest is the frame with the least distance to its image, the rectangle. The neighbour is the frame
    before or after it on whose other side the point lies; weights go by the distances to both planes. Past
    the last frame the nearest counts alone.

    Parameters
    ----------
    points_mm : ndarray, shape (k, 3)
        In the world.
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    """
    points = np.asarray(points_mm, dtype=float).reshape(-1, 3)
    image_from_world = world_from_image.inv().as_matrix()
    rows = max(_AT_ONCE // len(world_from_image), 1)
    parts = [
        _place(points[first : first + rows], image_from_world, grid)
        for first in range(0, max(len(points), 1), rows)
    ]
    return Belonging(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def require_inside(points_mm: FloatArray, grid: ImageGrid, world_from_image: RigidTransform) -> Belonging:
    """Find frames of points in the sweep: between two frames, or within `REACH_MM` of that.

    Raises
    ------
    InvalidInputError
        Naming the first point that lies outside.
    """
    beyond = np.flatnonzero(~np.isfinite(points_mm).all(axis=1))
    if beyond.size:
        raise InvalidInputError(
            f"point {beyond[0] + 1}: expected a point in the sweep, got one beyond the cut"
        )
    near = belonging_of(points_mm, grid, world_from_image)
    outside = np.flatnonzero(near.gap_mm > REACH_MM)
    if outside.size:
        row = int(outside[0])
        x, y, z = points_mm[row]
        raise InvalidInputError(
            f"point {row + 1} ({x:g}, {y:g}, {z:g}): expected a point in the sweep, got one "
            f"{near.gap_mm[row]:.2f} mm from its nearest image: is it a point of this mode's world?"
        )
    return near


def _place(
    points: FloatArray, image_from_world: FloatArray, grid: ImageGrid
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Frames, weights and gaps of some points."""
    x, y, q = np.moveaxis(image_from_world[:, :3] @ np.insert(points, 3, 1.0, axis=1).T, 1, 0)
    (left, top), (right, bottom) = grid.extent_mm
    beside = (x - np.clip(x, left, right)) ** 2 + (y - np.clip(y, top, bottom)) ** 2
    away = q**2 + beside
    row, best = np.arange(len(points)), away.argmin(axis=0)
    height, second, weight = q[best, row], np.zeros(len(points), dtype=np.int64), np.zeros(len(points))
    for step in (-1, 1):
        neighbour = np.clip(best + step, 0, len(q) - 1)
        share = np.abs(height) / np.maximum(np.abs(height) + np.abs(q[neighbour, row]), 1e-12)
        # Of two neighbours on the other side, where the probe turns back, the nearer.
        across = (height * q[neighbour, row] < 0) & (neighbour != best) & (share > weight)
        second[across], weight[across] = neighbour[across], share[across]
    gap = np.sqrt(np.where(weight > 0.0, beside[best, row], away[best, row]))
    return np.stack([best, second], axis=1), np.stack([1.0 - weight, weight], axis=1), gap


def variances(
    errors: PoseErrors, points_mm: FloatArray, directions: FloatArray, belonging: Belonging
) -> FloatArray:
    """Variance of points' places along directions, shape (k,), mm2.

    Parameters
    ----------
    points_mm, directions : ndarray, shape (k, 3)
        In the world; directions of length one.
    """
    forces, screws = _forces(points_mm, directions, belonging), _screws(errors)
    along = np.sum([forces[:, j, None] @ screws[belonging.frames[:, j]] for j in (0, 1)], axis=0)
    return np.asarray((along**2).sum(axis=(1, 2)))


def changes(
    errors: PoseErrors, points_mm: FloatArray, gradient: FloatArray, belonging: Belonging
) -> FloatArray:
    """Change of a quantity for one standard deviation of each variable of the errors, shape (m,).

    Parameters
    ----------
    points_mm, gradient : ndarray, shape (k, 3)
        Points in the world, and the quantity's derivative with respect to each.
    """
    frames, n = belonging.frames.T.ravel(), len(errors.world_from_image)
    forces = [np.bincount(frames, f.ravel(), n) for f in _forces(points_mm, gradient, belonging).T]
    return np.asarray(np.einsum("an,nam->m", forces, _screws(errors)))


def _screws(errors: PoseErrors) -> FloatArray:
    """Displacement and rotation of each frame by each variable, about the origin, shape (n, 6, m).

    What it displaces a point by along a force is the product with the force and its moment.
    """
    along = errors.world_from_image[0].rotation.as_matrix().T
    shift, turn = errors.factors[..., :3] @ along, errors.factors[..., 3:] @ along
    centres = errors.world_from_image.apply(errors.centre_mm)
    return np.concatenate([shift - np.cross(turn, centres), turn], axis=-1).transpose(1, 2, 0)


def _forces(points_mm: FloatArray, along: FloatArray, belonging: Belonging) -> FloatArray:
    """Gradients at points and their moments, distributed to the points' frames, shape (k, 2, 6)."""
    moments = np.hstack([along, np.cross(points_mm, along)])
    return np.asarray(belonging.weights[..., None] * moments[:, None])
