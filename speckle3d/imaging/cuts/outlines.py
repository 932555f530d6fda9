"""Outlines of a sweep's frames in the world, and the lines in which frames cross a plane."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.images import image_corners

_ON_PLANE_MM = 1e-6
_STEPS = 256
"""Places along a line at which it is looked whether it lies in a fan."""


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

    Examples
    --------
    >>> grid = ImageGrid(3, 5, 1.0, 0.5)
    >>> frame_outlines(grid, RigidTransform.identity(1))[0, :, :2].tolist()
    [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [0.0, 0.0]]
    """
    return image_corners(grid, world_from_image)[:, [0, 1, 2, 3, 0]]


def crossings(outlines_mm: FloatArray, world_from_plane: RigidTransform) -> FloatArray:
    """Lines in which frames cross a plane.

    Parameters
    ----------
    outlines_mm : ndarray, shape (n, 5, 3)
        From `frame_outlines`.
    world_from_plane : RigidTransform, single
        The plane is its x and y.

    Returns
    -------
    ndarray, shape (n, 2, 2)
        Both ends of each frame's line, x and y in the plane, the end nearer to the probe first; NaN for
        frames that do not cross it.
    """
    corners = world_from_plane.inv().apply(outlines_mm.reshape(-1, 3)).reshape(-1, 5, 3)
    corners[np.abs(corners[..., 2]) < _ON_PLANE_MM, 2] = 0.0
    # Along each edge of the outline from 0 at its first corner; edges count from the top one, clockwise.
    start, change = corners[:, :-1], np.diff(corners, axis=1)
    # A corner on the plane counts as in front of it, so that every line has two ends.
    crosses = (start[..., 2] < 0) != (corners[:, 1:, 2] < 0)
    share = -start[..., 2] / np.where(crosses, change[..., 2], 1.0)
    at = start[..., :2] + share[..., None] * change[..., :2]
    depth = np.where(crosses, np.array([0.0, 0.0, 1.0, 1.0]) + share * [0.0, 1.0, 0.0, -1.0], np.inf)
    nearer = np.argsort(depth, axis=1, kind="stable")[:, :2]
    ends = np.take_along_axis(at, nearer[..., None], axis=1)
    ends[crosses.sum(axis=1) != 2] = np.nan
    return ends


def within_fan(lines_mm: FloatArray, plane_from_image: RigidTransform, grid: ImageGrid) -> FloatArray:
    """Lines where they lie in the images of their frames: a fan does not fill its box.

    Parameters
    ----------
    lines_mm : ndarray, shape (n, 2, 2)
        From `crossings`.
    plane_from_image : RigidTransform, length n
    grid : ImageGrid
        Of the images as they were recorded.

    Returns
    -------
    ndarray, shape (n, m, 2)
        Of a fan, points along each line, NaN outside; of parallel vectors, the lines as they are.
    """
    if grid.fan is None:
        return lines_mm
    points = np.linspace(lines_mm[:, 0], lines_mm[:, 1], _STEPS, axis=1)
    image_from_plane = plane_from_image.inv().as_matrix()
    places = np.einsum("nij,nkj->nki", image_from_plane[:, :2, :2], points) + image_from_plane[:, None, :2, 3]
    sample = grid.sample_at(places)
    inside = np.all((sample >= 0) & (sample <= [grid.vectors - 1, grid.samples - 1]), axis=-1)
    return np.where(inside[..., None], points, np.nan)
