"""Volumes voxel by voxel, for sparse sweeps: each interpolated between the images nearest on either side.

Where images lie farther apart than voxels, samples put into voxels leave gaps that hole filling closes with means
of what is near. Here each voxel looks up the images instead: linear between two images, bilinear in either.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.threads import in_parallel
from speckle3d.imaging.grid import Slab, VoxelGrid
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.region import Region

BYTES_PER_VOXEL = 21
"""Distance and level of an image on either side, the voxel, and its state."""

MAX_MEMORY_GB = 2.5
"""Default memory of a slab."""

_BATCH = 16
"""Images read at a time: enough for milliseconds of work per thread, few enough for memory."""


def backward_slabs(
    source: PosedImages,
    voxel_grid: VoxelGrid,
    reach_mm: float,
    region: Region | None = None,
    max_memory_gb: float = MAX_MEMORY_GB,
) -> Iterator[Slab]:
    """Make a volume slab by slab along k, each voxel from the images nearest to it on either side.

    A voxel is measured where an image passes within half a voxel of its centre, along the voxel axis that the
    image is most nearly perpendicular to, and filled where it lies between two images; beyond the first and
    the last image, and where images are farther away than `reach_mm`, it stays empty. Images that do not reach
    a slab are not read for it.

    Parameters
    ----------
    source : PosedImages
    voxel_grid : VoxelGrid
    reach_mm : float
        Images this far from a voxel, at right angles to the image, or farther do not count.
    region : Region, optional
        Part of the images that counts; without it, all.
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
    if not (np.isfinite(reach_mm) and reach_mm > 0):
        raise InvalidInputError(f"reach_mm: expected a value above zero, got {reach_mm}")
    outside = None if region is None else ~region.mask(source.grid)
    planes = _planes_at_once(source, voxel_grid, max_memory_gb)
    maps = _index_from_voxel(source, voxel_grid)
    half_mm = _half_voxel_mm(source, voxel_grid)
    n_k = voxel_grid.shape[2]
    return (
        _slab(source, voxel_grid, maps, reach_mm, half_mm, outside, first, min(first + planes, n_k))
        for first in range(0, n_k, planes)
    )
