"""Volumes voxel by voxel, for sparse sweeps: each interpolated between the images nearest on either side.

Where images lie farther apart than voxels, samples put into voxels leave gaps, which hole filling closes with
means of what is near. Here each voxel looks up the images: linear between two of them, bilinear in either.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.nearest import BATCH, BYTES_PER_POINT, NearestImages
from speckle3d.imaging.voxels.grid import Slab, VoxelGrid, even_planes

BYTES_PER_VOXEL = BYTES_PER_POINT + 14
"""Images on either side; voxel, state and a copy of another type; voxel and state of the slab before."""

MAX_MEMORY_GB = 2.5
"""Default memory of a slab."""


def backward_slabs(
    source: PosedImages,
    voxel_grid: VoxelGrid,
    reach_mm: float,
    region: BoolArray | None = None,
    max_memory_gb: float = MAX_MEMORY_GB,
) -> Iterator[Slab]:
    """Make a volume slab by slab along k, each voxel from the images nearest to it on either side.

    A voxel is measured where an image passes within half a voxel of its centre, along the voxel axis that
    the images are most nearly perpendicular to, and filled where it lies between two images; beyond the first
    and the last image, and where images are farther away than `reach_mm`, it stays empty. Images that do not
    reach a slab are not read for it.

    Parameters
    ----------
    source : PosedImages
    voxel_grid : VoxelGrid
    reach_mm : float
        Images this far from a voxel, at right angles to the image, or farther do not count.
    region : ndarray of bool, shape (vector, sample), optional
        Samples that count; by default all.
    max_memory_gb : float
        For a slab, and the 16 images that are read at a time.

    Yields
    ------
    Slab
        From k = 0 on.

    Raises
    ------
    InvalidInputError
        If `reach_mm` is not positive, or one plane takes more than `max_memory_gb`.

    References
    ----------
    .. [1] W. Wein et al., "Backward-warping ultrasound reconstruction for improving diagnostic value and
       registration", MICCAI, 2006.
    """
    images = NearestImages(source, reach_mm, region)
    planes = _planes_at_once(source, voxel_grid, max_memory_gb)
    half_mm = _half_voxel_mm(images.normals, voxel_grid)
    n_k = voxel_grid.shape[2]
    for first in range(0, n_k, planes):
        yield _slab(images, voxel_grid, half_mm, first, min(first + planes, n_k))


def _slab(images: NearestImages, voxel_grid: VoxelGrid, half_mm: float, first: int, stop: int) -> Slab:
    n_i, n_j, _ = voxel_grid.shape
    rows, corners = _rows(voxel_grid, first, stop), _corners_mm(voxel_grid, first, stop)
    voxels, state = images.beside(rows, n_i, corners).blended(half_mm)
    return Slab(first, voxels.reshape(-1, n_j, n_i), state.reshape(-1, n_j, n_i))


def _half_voxel_mm(normals: FloatArray, voxel_grid: VoxelGrid) -> float:
    """Half a voxel along the axis that an image is most nearly perpendicular to, of the most upright one."""
    along = normals @ voxel_grid.world_from_grid.rotation.as_matrix()
    return 0.5 * float(np.abs(along * voxel_grid.spacing_mm).max())


def _rows(voxel_grid: VoxelGrid, first: int, stop: int) -> FloatArray:
    """Rows of voxels along i: the centre of the first and the step to the next, shape (n, 2, 3), mm."""
    pose = voxel_grid.world_from_grid.as_matrix()[:3]
    steps = pose[:, :3] * voxel_grid.spacing_mm
    j, k = np.arange(voxel_grid.shape[1])[:, None], np.arange(first, stop)[:, None, None]
    rows = np.empty((stop - first, voxel_grid.shape[1], 2, 3))
    # Each worked out by itself, so that it does not depend on the slab.
    rows[:, :, 0] = pose[:, 3] + j * steps[:, 1] + k * steps[:, 2]
    rows[:, :, 1] = steps[:, 0]
    return rows.reshape(-1, 2, 3)


def _corners_mm(voxel_grid: VoxelGrid, first: int, stop: int) -> FloatArray:
    """Centres of the corner voxels in the world, shape (8, 3)."""
    n_i, n_j, _ = voxel_grid.shape
    index = [[i, j, k] for i in (0, n_i - 1) for j in (0, n_j - 1) for k in (first, stop - 1)]
    return np.asarray(voxel_grid.world_from_grid.apply(np.multiply(index, voxel_grid.spacing_mm)))


def _planes_at_once(source: PosedImages, voxel_grid: VoxelGrid, max_memory_gb: float) -> int:
    """Planes of a slab."""
    n_i, n_j, n_k = voxel_grid.shape
    images_gb = BATCH * source.grid.vectors * source.grid.samples * 4 / 1e9
    plane_gb = n_i * n_j * BYTES_PER_VOXEL / 1e9
    planes = int(min((max_memory_gb - images_gb) / plane_gb, n_k))
    if planes < 1:
        raise InvalidInputError(
            f"volume: expected to work within {max_memory_gb:g} GB of memory, but a plane of {n_i} x {n_j} "
            f"voxels and {BATCH} images take {images_gb + plane_gb:.3g} GB: take larger voxels"
        )
    return even_planes(n_k, planes)
