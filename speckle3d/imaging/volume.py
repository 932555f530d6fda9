"""Voxels from a sweep's images: every sample averaged into its voxel, then the holes filled.

Voxels are indexed ``[i, j, k]`` along the grid's x, y and z, which are the world's axes unless asked
otherwise: in the mode `image` lateral, axial and elevational of the first frame.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.ndimage import distance_transform_cdt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.sweep import ImageGrid
from speckle3d.core.volume import Volume
from speckle3d.imaging.grid import VoxelGrid, grid_around
from speckle3d.imaging.images import Images, PosedImages

DEFAULT_FILL_RADIUS = 3
"""Voxels across which holes are filled: a gap between frames of up to six voxels closes."""

MAX_MEMORY_GB = 4.0
"""Default limit of memory: a larger volume is more often due to a wrong unit than to a large sweep."""

VoxelType = Literal["float32", "uint8"]


def compound(
    images: Images,
    grid: ImageGrid,
    world_from_image: RigidTransform,
    voxel_mm: float,
    *,
    fill_radius: int = DEFAULT_FILL_RADIUS,
    voxel_type: VoxelType = "float32",
    world_from_axes: Rotation | None = None,
    max_memory_gb: float = MAX_MEMORY_GB,
) -> Volume:
    """Compound a sweep's images into cubic voxels that hold all of it.

    Each voxel is the mean of all samples in it. An empty voxel is then the mean of those that are not in
    the smallest cube around it that holds any; filled voxels stay as they are.

    Parameters
    ----------
    images : indexable or callable
        Grey images by frame number, shape (vector, sample), read one at a time.
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    voxel_mm : float
    fill_radius : int
        Half the edge of the largest such cube, in voxels; beyond it, and with 0 everywhere, empty voxels
        stay empty. The volume also grows by so many voxels beyond the first and the last frame.
    voxel_type : {"float32", "uint8"}
        With "float32" empty voxels are NaN. With "uint8" levels are rounded and clipped to 0-255, and empty
        voxels are 0.
    world_from_axes : Rotation, optional
        Directions of the voxel axes; without it, the world's.
    max_memory_gb : float

    Returns
    -------
    Volume

    Raises
    ------
    InvalidInputError
        If the volume would take more than `max_memory_gb`, or an input is not what it must be.
    InsufficientDataError
        If no sample has a value.

    References
    ----------
    .. [1] R. Rohling, A. Gee and L. Berman, "A comparison of freehand three-dimensional ultrasound
       reconstruction techniques", Medical Image Analysis, 1999.

    Examples
    --------
    Four images, 1 mm apart, of four vectors and five samples:

    >>> import numpy as np
    >>> from scipy.spatial.transform import RigidTransform
    >>> from speckle3d.core.sweep import ImageGrid
    >>> grid = ImageGrid(vectors=4, samples=5, vector_pitch_mm=1.0, sample_spacing_mm=1.0)
    >>> poses = RigidTransform.from_translation([[0.0, 0.0, z] for z in range(4)])
    >>> volume = compound([np.full((4, 5), level) for level in range(4)], grid, poses, voxel_mm=1.0)
    >>> volume.shape, volume.voxels[0, 0].tolist()
    ((4, 5, 4), [0.0, 1.0, 2.0, 3.0])
    """
    voxel_grid = grid_around(grid, world_from_image, voxel_mm, world_from_axes)
    _require_options(voxel_grid, fill_radius, voxel_type, max_memory_gb)
    mean = _bin_mean(voxel_grid, PosedImages(images, grid, world_from_image))
    _fill_holes(mean, fill_radius)
    voxels = _as_uint8(mean) if voxel_type == "uint8" else mean
    return Volume(voxels, voxel_grid.spacing_mm, voxel_grid.world_from_grid)


def _require_options(voxel_grid: VoxelGrid, fill_radius: int, voxel_type: str, max_memory_gb: float) -> None:
    if fill_radius < 0:
        raise InvalidInputError(f"fill_radius: expected zero or more voxels, got {fill_radius}")
    if voxel_type not in ("float32", "uint8"):
        raise InvalidInputError(f"voxel_type: expected 'float32' or 'uint8', got {voxel_type!r}")
    if voxel_grid.memory_gb > max_memory_gb:
        voxels = " x ".join(str(n) for n in voxel_grid.shape)
        spacing = " x ".join(f"{step:g}" for step in voxel_grid.spacing_mm)
        raise InvalidInputError(
            f"volume: expected at most {max_memory_gb:g} GB of memory, got {voxel_grid.memory_gb:.3g} GB for "
            f"{voxels} voxels of {spacing} mm: take larger voxels, or check the poses"
        )


def _bin_mean(voxel_grid: VoxelGrid, source: PosedImages) -> Float32Array:
    """Mean of the samples in each voxel; NaN where there is none."""
    from speckle3d.kernels.compounding import add_samples

    total = np.zeros(voxel_grid.shape, dtype=np.float32)
    count = np.zeros(voxel_grid.shape, dtype=np.uint32)
    for index, index_from_sample in enumerate(_index_from_sample(voxel_grid, source)):
        add_samples(source.read(index), index_from_sample, total, count)
    if not count.any():
        raise InsufficientDataError("volume: expected samples with values inside the grid, got none")
    with np.errstate(invalid="ignore"):  # 0 / 0 is the NaN that marks an empty voxel
        return np.divide(total, count, out=total, casting="same_kind")


def _index_from_sample(voxel_grid: VoxelGrid, source: PosedImages) -> FloatArray:
    """Per image, the map from (vector, sample, 1) to fractional (i, j, k), shape (n, 3, 3)."""
    grid_from_image = voxel_grid.world_from_grid.inv() * source.world_from_image
    maps = grid_from_image.rotation.as_matrix() @ source.grid.image_from_sample
    maps[:, :, 2] += grid_from_image.translation
    maps /= np.asarray(voxel_grid.spacing_mm)[:, None]
    return np.ascontiguousarray(maps)


def _fill_holes(voxels: Float32Array, fill_radius: int) -> None:
    from speckle3d.kernels.compounding import fill_from_shell

    empty = np.isnan(voxels)
    if fill_radius > 0 and empty.any():
        distance = distance_transform_cdt(empty, metric="chessboard")
        fill_from_shell(voxels, np.asarray(distance, dtype=np.int32), fill_radius)


def _as_uint8(voxels: Float32Array) -> ByteArray:
    rounded = np.nan_to_num(np.rint(voxels), nan=0.0)
    return np.clip(rounded, 0.0, 255.0, out=rounded).astype(np.uint8)
