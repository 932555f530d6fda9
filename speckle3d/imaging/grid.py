"""Where voxels lie: grids around a sweep's images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.images import require_poses


@dataclass(frozen=True)
class VoxelGrid:
    """Where voxels lie.

    Parameters
    ----------
    shape : tuple of int
        Number of voxels along i, j and k.
    spacing_mm : tuple of float
        Distance between neighbouring voxel centres along i, j and k.
    world_from_grid : RigidTransform
        Its origin is the centre of voxel ``[0, 0, 0]``; mm.
    """

    shape: tuple[int, int, int]
    spacing_mm: tuple[float, float, float]
    world_from_grid: RigidTransform

    def part(self, first: int, stop: int) -> VoxelGrid:
        """The planes `first` to before `stop` along k as a grid of their own."""
        start = self.world_from_grid * RigidTransform.from_translation([0, 0, first * self.spacing_mm[2]])
        return VoxelGrid((*self.shape[:2], stop - first), self.spacing_mm, start)

    def size_gb(self, voxel_type: str) -> float:
        """Size of the voxels alone, GB."""
        return math.prod(float(n) for n in self.shape) * np.dtype(voxel_type).itemsize / 1e9

    def __str__(self) -> str:
        voxels = " x ".join(str(n) for n in self.shape)
        return f"{voxels} voxels of {' x '.join(f'{step:g}' for step in self.spacing_mm)} mm"


def grid_around(
    grid: ImageGrid,
    world_from_image: RigidTransform,
    voxel_mm: float,
    world_from_axes: Rotation | None = None,
) -> VoxelGrid:
    """Smallest grid of cubic voxels that holds the corners of every image.

    Parameters
    ----------
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    voxel_mm : float
    world_from_axes : Rotation, optional
        Directions of the voxel axes; without it, the world's.

    Raises
    ------
    InvalidInputError
        If `voxel_mm` is not positive, or there are no poses.
    """
    if not (np.isfinite(voxel_mm) and voxel_mm > 0):
        raise InvalidInputError(f"voxel_mm: expected a value above zero, got {voxel_mm}")
    require_poses(world_from_image)
    axes = Rotation.identity() if world_from_axes is None else world_from_axes
    corners = np.concatenate([world_from_image.apply(corner) for corner in grid.corners_mm])
    along = axes.inv().apply(corners)
    low, high = along.min(axis=0), along.max(axis=0)
    # A corner half a voxel past the last centre would round up, and so may one a rounding error short of it.
    n_i, n_j, n_k = (int(n) + 1 for n in np.floor((high - low) / voxel_mm + 0.5 + 1e-6))
    placed = RigidTransform.from_components(axes.apply(low), axes)
    return VoxelGrid((n_i, n_j, n_k), (voxel_mm, voxel_mm, voxel_mm), placed)
