"""Outlines of a sweep's frames in the world."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.images import require_poses


def frame_outlines(grid: ImageGrid, world_from_image: RigidTransform) -> FloatArray:
    """Closed outline of every frame, through the centres of its corner samples.

    Parameters
    ----------
    grid : ImageGrid
    world_from_image : RigidTransform, length n

    Returns
    -------
    ndarray, shape (n, 5, 3)
        Top left, top right, bottom right, bottom left and top left again, mm in the world.
    """
    require_poses(world_from_image)
    corners = grid.corners_mm[[0, 1, 2, 3, 0]]
    return np.stack([world_from_image.apply(corner) for corner in corners], axis=1)
