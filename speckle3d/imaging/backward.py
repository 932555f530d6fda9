"""Volumes voxel by voxel, for sparse sweeps: each interpolated between the images nearest on either side.

Where images lie farther apart than voxels, samples put into voxels leave gaps, which hole filling closes with
means of what is near. Here each voxel looks up the images: linear between two of them, bilinear in either.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from speckle3d.core.arrays import BoolArray, Float32Array, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.threads import in_parallel
from speckle3d.imaging.grid import Slab, VoxelGrid
from speckle3d.imaging.images import PosedImages

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
    if not (np.isfinite(reach_mm) and reach_mm > 0):
        raise InvalidInputError(f"reach_mm: expected a value above zero, got {reach_mm}")
    if region is not None and region.shape != (source.grid.vectors, source.grid.samples):
        expected = (source.grid.vectors, source.grid.samples)
        raise InvalidInputError(f"region: expected shape {expected}, as the images, got {region.shape}")
    n_k = voxel_grid.shape[2]
    planes = _planes_at_once(source, voxel_grid, max_memory_gb)
    looked_up = _LookUp(source, voxel_grid, reach_mm, region)
    for first in range(0, n_k, planes):
        yield looked_up.slab(first, min(first + planes, n_k))


class _LookUp:
    """Images to look voxels up in, and where each voxel lies in each of them."""

    def __init__(
        self, source: PosedImages, voxel_grid: VoxelGrid, reach_mm: float, region: BoolArray | None
    ) -> None:
        self.source, self.shape, self.reach_mm = source, voxel_grid.shape, reach_mm
        self.outside = None if region is None else ~region
        image_from_world = source.world_from_image.inv().as_matrix()
        world_from_voxel = voxel_grid.world_from_grid.as_matrix() @ np.diag([*voxel_grid.spacing_mm, 1.0])
        maps = source.index_from_image() @ image_from_world @ world_from_voxel
        # "Behind" and "in front" must mean the same for all images, or neighbours of opposite facing
        # (a probe turned round between two passes) would compete for one side and leave the other empty.
        normal = image_from_world[:, 2, :3]
        maps[normal @ normal.sum(axis=0) < 0, 2] *= -1.0
        self.maps = np.ascontiguousarray(maps)
        # Half a voxel along the axis that an image is most nearly perpendicular to, for the most upright one.
        self.half_voxel_mm = 0.5 * float(np.abs(self.maps[:, 2, :3]).max())

    def slab(self, first: int, stop: int) -> Slab:
        """Planes `first` to before `stop`."""
        from speckle3d.kernels.backward import blend_planes, keep_nearest_in_planes

        n_i, n_j, _ = self.shape
        distance_mm = np.full((stop - first, 2, n_j, n_i), self.reach_mm, dtype=np.float32)
        grey = np.full(distance_mm.shape, np.nan, dtype=np.float32)
        for batch in self._near(first, stop):
            images = [self._read(int(index)) for index in batch]

            def look_up(low: int, high: int) -> None:
                for image, index in zip(images, batch, strict=True):  # noqa: B023 (done within the batch)
                    kept = distance_mm[low:high], grey[low:high]
                    keep_nearest_in_planes(image, self.maps[index], self.reach_mm, first + low, *kept)

            in_parallel(look_up, stop - first)
        voxels = np.empty((stop - first, n_j, n_i), np.float32)
        state = np.empty(voxels.shape, np.uint8)
        in_parallel(
            lambda low, high: blend_planes(
                distance_mm[low:high], grey[low:high], self.half_voxel_mm, voxels[low:high], state[low:high]
            ),
            stop - first,
        )
        return Slab(first, voxels, state)

    def _read(self, index: int) -> Float32Array:
        image = self.source.read(index)
        return image if self.outside is None else np.where(self.outside, np.float32(np.nan), image)

    def _near(self, first: int, stop: int) -> Iterator[IntArray]:
        """Numbers of the images that can reach some planes, a batch at a time."""
        near = np.flatnonzero(self._touch(first, stop))
        yield from np.split(near, range(_BATCH, len(near), _BATCH))

    def _touch(self, first: int, stop: int) -> BoolArray:
        """Whether each image's slab can reach the planes: no face of it has all eight corners beyond it."""
        n_i, n_j, _ = self.shape
        corners = np.array(
            [[i, j, k, 1] for i in (0, n_i - 1) for j in (0, n_j - 1) for k in (first, stop - 1)]
        )
        u, v, q = np.moveaxis(self.maps @ corners.T, 1, 0)
        grid = self.source.grid
        reach = (
            (u, 0.0, grid.vectors - 1.0),
            (v, 0.0, grid.samples - 1.0),
            (q, -self.reach_mm, self.reach_mm),
        )
        near = [(c.max(axis=1) > low - 1e-3) & (c.min(axis=1) < high + 1e-3) for c, low, high in reach]
        return np.asarray(near[0] & near[1] & near[2])


def _planes_at_once(source: PosedImages, voxel_grid: VoxelGrid, max_memory_gb: float) -> int:
    """Planes of a slab."""
    n_i, n_j, n_k = voxel_grid.shape
    images_gb = _BATCH * source.grid.vectors * source.grid.samples * 4 / 1e9
    plane_gb = n_i * n_j * BYTES_PER_VOXEL / 1e9
    planes = int(min((max_memory_gb - images_gb) / plane_gb, n_k))
    if planes < 1:
        raise InvalidInputError(
            f"volume: expected to work within {max_memory_gb:g} GB of memory, but a plane of {n_i} x {n_j} "
            f"voxels and {_BATCH} images take {images_gb + plane_gb:.3g} GB: take larger voxels"
        )
    # Slabs of nearly one size: none at the end that is worth little.
    return -(-n_k // -(-n_k // planes))
