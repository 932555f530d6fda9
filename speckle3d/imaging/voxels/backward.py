"""Volumes voxel by voxel, for sparse sweeps: each interpolated between the images nearest on either side.

Where images lie farther apart than voxels, samples put into voxels leave gaps, which hole filling closes with
means of what is near. Here each voxel looks up the images: linear between two of them, bilinear in either.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.nearest import NearestImages, look_up
from speckle3d.imaging.voxels.grid import VoxelGrid


def look_up_voxels(
    source: PosedImages, voxel_grid: VoxelGrid, reach_mm: float, region: BoolArray | None = None
) -> tuple[Float32Array, ByteArray]:
    """Give each voxel the level between the images nearest to it on either side.

    A voxel is measured where an image passes within half a voxel of its centre, along the voxel axis that
    the images are most nearly perpendicular to, and filled where it lies between two images; beyond the first
    and the last image, and where images are farther away than `reach_mm`, it stays empty.

    Parameters
    ----------
    source : PosedImages
    voxel_grid : VoxelGrid
    reach_mm : float
        Images this far from a voxel, at right angles to the image, or farther do not count.
    region : ndarray of bool, shape (vector, sample), optional
        Samples that count; by default all.

    Returns
    -------
    voxels : ndarray of float32, shape (n_k, n_j, n_i)
        NaN where they are empty.
    state : ndarray of uint8
        `EMPTY`, `MEASURED` or `FILLED` of `speckle3d.core.labels`.

    Raises
    ------
    InvalidInputError
        If `reach_mm` is not positive, or the region is not one of the images.

    References
    ----------
    .. [1] W. Wein et al., "Backward-warping ultrasound reconstruction for improving diagnostic value and
       registration", MICCAI, 2006.
    """
    n_i, n_j, n_k = voxel_grid.shape
    pose = voxel_grid.world_from_grid.as_matrix()[:3]
    steps = pose[:, :3] * voxel_grid.spacing_mm
    j, k = np.arange(n_j)[:, None], np.arange(n_k)[:, None, None]
    starts = (pose[:, 3] + j * steps[:, 1] + k * steps[:, 2]).reshape(-1, 3)
    rows = np.stack([starts, np.broadcast_to(steps[:, 0], starts.shape)], axis=1)
    corners = starts[[0, n_j - 1, -n_j, -1]]
    hull = np.concatenate([corners, corners + (n_i - 1) * steps[:, 0]])
    nearest = NearestImages(source, rows, n_i, hull, reach_mm)
    look_up([nearest], region)
    # Half a voxel along the axis that an image is most nearly perpendicular to, of the most upright one.
    normals = source.world_from_image.rotation.apply([0.0, 0.0, 1.0])
    voxels, state = nearest.blended(0.5 * float(np.abs(normals @ steps).max()))
    return voxels.reshape(n_k, n_j, n_i), state.reshape(n_k, n_j, n_i)
