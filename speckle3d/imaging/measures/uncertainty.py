"""Uncertainty as an image: per voxel, the standard deviation of position along the sweep."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import zoom

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray
from speckle3d.core.grid import ImageGrid
from speckle3d.core.poses import PoseErrors
from speckle3d.imaging.measures.belonging import belonging_of, variances
from speckle3d.imaging.voxels.grid import VoxelGrid

COARSE_MM = 0.75
"""Distance of the points at which the deviation is computed; between them it is interpolated linearly."""
_AT_ONCE = 2**11
"""Points worked on at a time: 20 MB with the errors of 300 frames."""


def deviation_volume(
    errors: PoseErrors, grid: ImageGrid, voxel_grid: VoxelGrid, state: ByteArray | None = None
) -> Float32Array:
    """Standard deviation of position along the sweep in every voxel, shape (n_k, n_j, n_i), mm.

    A voxel moves with the frames nearest to it (`belonging_of`), and along the sweep is the direction of
    their elevational axis. Deviations are computed on a coarse grid and interpolated, which is off by some
    hundredths of the largest. Where the probe passes twice, the nearer pass counts; between voxels
    of the one and of the other the deviation jumps, and is blurred over the coarse grid's step.

    Parameters
    ----------
    errors : PoseErrors
    grid : ImageGrid
    voxel_grid : VoxelGrid
    state : ndarray of uint8, shape (n_k, n_j, n_i), optional
        Where it is 0, empty, the result is NaN.
    """
    extent = (np.array(voxel_grid.shape) - 1) * voxel_grid.spacing_mm
    counts = np.maximum(np.ceil(extent / COARSE_MM), 1).astype(int) + 1
    axes = [np.linspace(0.0, size, count) for size, count in zip(extent, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    world = voxel_grid.world_from_grid.apply(points)
    parts = range(0, len(world), _AT_ONCE)
    values = np.concatenate([deviations(errors, grid, world[k : k + _AT_ONCE]) for k in parts])
    fine = zoom(values.reshape(counts), np.divide(voxel_grid.shape, counts), order=1)
    deviation = np.ascontiguousarray(fine.T, dtype=np.float32)
    if state is not None:
        deviation[state == 0] = np.nan
    return deviation


def deviations(errors: PoseErrors, grid: ImageGrid, points_mm: FloatArray) -> FloatArray:
    """Standard deviation of points' positions along the sweep, shape (k,), mm."""
    near = belonging_of(points_mm, grid, errors.world_from_image)
    along = errors.world_from_image.rotation[near.frames[:, 0]].apply([0.0, 0.0, 1.0])
    return np.sqrt(variances(errors, points_mm, along, near))
