"""Axes for voxels: mean axes of the images, or those of the smallest box."""

from __future__ import annotations

import numpy as np
from scipy.optimize import fmin
from scipy.spatial import ConvexHull
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.images import image_corners

_LEAST_ALIKE = 0.55
"""Mean squared cosine to a direction in common: as of a spread of 80 degrees either way; all round 0.5."""

_TURNS = Rotation.from_rotvec(np.stack(np.meshgrid(*[np.linspace(-0.7, 0.7, 7)] * 3), axis=-1).reshape(-1, 3))
"""Turns at which the smallest box is looked for: with quarter turns, near any orientation there is."""
_SEARCHES = 4
"""Of those, how many are searched from: the smallest box is not the only minimum."""
_SIMPLEX = np.vstack([np.zeros(3), 0.15 * np.eye(3)])
"""Turns with which each search begins, rad."""


def sweep_axes(world_from_image: RigidTransform) -> Rotation:
    """Mean orientation of a sweep's images: axes that are lateral, axial and elevational.

    Images of a probe that was turned about its depth axis between two passes count as turned back: lateral
    and elevational are those of the first image.

    Parameters
    ----------
    world_from_image : RigidTransform, length n

    Raises
    ------
    InsufficientDataError
        If the images have no lateral, axial or elevational direction in common, as when the probe turned
        through half a circle.
    """
    images = world_from_image.rotation.as_matrix()
    axes = np.stack([line_along(images[:, :, axis]) for axis in range(3)], axis=1)
    alike = np.square(np.einsum("nia,ia->na", images, axes)).mean(axis=0)
    if alike.min() < _LEAST_ALIKE:
        axis = ("lateral", "axial", "elevational")[int(alike.argmin())]
        raise InsufficientDataError(
            f"the images have no {axis} direction in common: expected one sweep, or axes as asked for"
        )
    return Rotation.from_matrix(axes)


def principal_axes(grid: ImageGrid, world_from_image: RigidTransform) -> Rotation:
    """Axes of the smallest box around a sweep's images, nearest to lateral, axial and elevational.

    The volume of the box is minimised from the best of many orientations. Unless another is smaller by
    0.01 %, it is `sweep_axes`, then the world's axes.

    Parameters
    ----------
    grid : ImageGrid
    world_from_image : RigidTransform, length n

    Returns
    -------
    Rotation
        World from the box's axes, right-handed: i is nearest to lateral, j to axial, k to elevational, of the
        mean image or, where the images have no mean, of the first.

    Raises
    ------
    InvalidInputError
        If there are no poses.
    """
    points = image_corners(grid, world_from_image).reshape(-1, 3)
    # Joggled, so that points in a plane have a hull as well.
    points = points[ConvexHull(points, qhull_options="QJ").vertices]
    try:
        lateral_first = sweep_axes(world_from_image)
    except InsufficientDataError:
        lateral_first = world_from_image[0].rotation
    # A sheet has no volume: a sample's width more on all sides makes of two sheets the smaller one.
    skin = min(grid.vector_pitch_mm, grid.sample_spacing_mm)

    def log_volumes(axes: Rotation) -> FloatArray:
        return np.asarray(np.log(np.ptp(points @ axes.as_matrix(), axis=-2) + skin).sum(axis=-1))

    def smallest_near(start: Rotation) -> Rotation:
        def log_volume(turn_rad: FloatArray) -> float:
            return float(log_volumes(start * Rotation.from_rotvec(turn_rad)))

        turn = fmin(log_volume, np.zeros(3), (), 1e-6, 1e-6, initial_simplex=_SIMPLEX, disp=False)
        return start * Rotation.from_rotvec(turn)

    starts = lateral_first * _TURNS
    starts = starts[np.argsort(log_volumes(starts), kind="stable")[:_SEARCHES]]
    boxes = Rotation.concatenate([lateral_first, Rotation.identity(), *map(smallest_near, starts)])
    volume = log_volumes(boxes)
    axes = boxes[int(np.argmax(volume <= volume.min() + 1e-4))] * Rotation.create_group("O")
    return axes[int((lateral_first.inv() * axes).magnitude().argmin())]


def line_along(directions: FloatArray) -> FloatArray:
    """Axis of unsigned directions by least squares.

    Parameters
    ----------
    directions : ndarray, shape (n, 3)
        Unit vectors.

    Returns
    -------
    ndarray, shape (3,)
        Unit vector along the line, as the first direction points.
    """
    line = np.asarray(np.linalg.eigh(directions.T @ directions)[1][:, -1], dtype=float)
    return line if directions[0] @ line >= 0 else -line
