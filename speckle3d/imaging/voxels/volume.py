"""Compound a sweep's images into voxels, in memory.

Voxels are indexed ``[i, j, k]`` along the grid's x, y and z, which are the world's axes unless asked
otherwise: in the mode `image` lateral, axial and elevational of the first frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.text import shown
from speckle3d.core.threads import in_parallel
from speckle3d.core.volume import Volume
from speckle3d.imaging.images import Images, PosedImages
from speckle3d.imaging.nearest import NearestImages, look_up
from speckle3d.imaging.voxels.grid import VoxelGrid, grid_around
from speckle3d.imaging.voxels.holes import fill_holes
from speckle3d.imaging.voxels.settings import CompoundingSettings, VoxelType
from speckle3d.imaging.voxels.splatting import splat_images
from speckle3d.io.toml import validated

_BYTES_PER_VOXEL = 25
"""Of work beside the voxels' own type: sum and weight, or two images beside it; tag, level and state."""


@shown
@dataclass(frozen=True)
class CompoundedVolume(Volume):
    """A volume with the state of its voxels: measured, filled or empty.

    Attributes
    ----------
    state : ndarray of uint8, shape (n_i, n_j, n_k)
        `EMPTY`, `MEASURED` or `FILLED`; see `speckle3d.core.volume`.
    """

    state: ByteArray = field(kw_only=True)


def compound(
    images: Images,
    grid: ImageGrid,
    world_from_image: RigidTransform,
    voxel_mm: float | None = None,
    *,
    voxel_grid: VoxelGrid | None = None,
    weights: FloatArray | None = None,
    region: BoolArray | None = None,
    world_from_axes: Rotation | None = None,
    **settings: Any,
) -> CompoundedVolume:
    """Compound a sweep's images into voxels, cubic ones that hold all of it or those of a grid.

    With "nearest" a sample counts in the voxel it lies in; with "linear" in the eight whose centres are
    around it, by trilinear shares. A voxel becomes the mean of its samples by their shares, their maximum,
    the mean of those of the latest image that has any there, or their mean by weight; with "linear", shares
    below 1/8 do not count for the maximum and the latest. With "plus" the mean is kept in whole grey levels,
    as PLUS and 3D Slicer keep it; see `speckle3d.imaging.voxels.splatting`.

    An empty voxel then becomes the mean of the measured ones in the smallest cube around it that holds any;
    measured voxels stay as they are.

    Parameters
    ----------
    images : indexable or callable
        Grey images by frame number, shape (vector, sample), read one at a time; the latest is the last.
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    voxel_mm : float, optional
        Side of cubic voxels; or give `voxel_grid`.
    voxel_grid : VoxelGrid, optional
        Where voxels lie; samples elsewhere are left out.
    weights : ndarray, shape (n,), optional
        Of the frames, zero or more, for the rule "weighted".
    region : ndarray of bool, shape (vector, sample), optional
        Samples that count; by default all.
    world_from_axes : Rotation, optional
        Directions of the axes of cubic voxels; without it, the world's.
    **settings
        Fields of `CompoundingSettings`: `splat` ("nearest", "linear"), `rule` ("mean", "maximum", "latest",
        "weighted", "plus"), `fill_radius` (half the edge of the largest such cube, in voxels; by default
        3), `fill_mm`, `max_memory_gb`, `voxel_type` (by default
        "float32", in which empty voxels are NaN; in others levels are rounded and clipped, and empty voxels
        0), and `backward_mm` for sparse sweeps: above zero, each voxel is interpolated between the images
        nearest on either side, up to this far from it, without splat, rule and filling.

    Returns
    -------
    CompoundedVolume

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
    >>> from speckle3d.core.grid import ImageGrid
    >>> grid = ImageGrid(vectors=4, samples=5, vector_pitch_mm=1.0, sample_spacing_mm=1.0)
    >>> poses = RigidTransform.from_translation([[0.0, 0.0, z] for z in range(4)])
    >>> volume = compound([np.full((4, 5), level) for level in range(4)], grid, poses, voxel_mm=1.0)
    >>> volume.shape, volume.voxels[0, 0].tolist()
    ((4, 5, 4), [0.0, 1.0, 2.0, 3.0])
    """
    if (voxel_mm is None) == (voxel_grid is None):
        raise InvalidInputError("compound: expected either voxel_mm or voxel_grid")
    without_effect = {"levels", "dynamic_range_db"}  # those of the images
    if settings.get("backward_mm"):
        without_effect |= {"splat", "rule", "fill_radius", "fill_mm"}
    if names := sorted(without_effect & settings.keys()):
        raise InvalidInputError(f"compound: {', '.join(names)}: without effect on these images: leave it out")
    source = PosedImages(images, grid, world_from_image)
    if voxel_grid is None:
        voxel_grid = grid_around(grid, world_from_image, float(voxel_mm or 0.0), world_from_axes)
    model = validated({"voxel_type": "float32", **settings}, "compound", CompoundingSettings)
    return compound_onto(voxel_grid, source, model, weights, region)


def compound_onto(
    voxel_grid: VoxelGrid,
    source: PosedImages,
    settings: CompoundingSettings,
    weights: FloatArray | None = None,
    region: BoolArray | None = None,
) -> CompoundedVolume:
    """Compound images into the voxels of a grid, by settings; else as `compound`.

    Of the settings, `voxel_mm`, `levels` and `dynamic_range_db` are not read: the grid and the images have
    them. With `backward_mm` neither are `splat`, `rule` and the filling's.
    """
    kind = settings.voxel_type
    needed_gb = voxel_grid.size_gb(kind) + _BYTES_PER_VOXEL * voxel_grid.size_gb("uint8")
    if needed_gb > settings.max_memory_gb:
        raise InvalidInputError(
            f"volume: expected at most {settings.max_memory_gb:g} GB of memory, got {needed_gb:.3g} GB for "
            f"{voxel_grid}: take larger voxels, or check the poses"
        )
    if settings.backward_mm > 0:
        voxels, state = look_up_voxels(source, voxel_grid, settings.backward_mm, region)
    else:
        voxels, state = splat_images(source, voxel_grid, settings.splat, settings.rule, weights, region)
        if settings.fill_mm > 0:
            fill_holes(voxels, state, settings.fill_mm, voxel_grid.spacing_mm)
        else:
            fill_holes(voxels, state, settings.fill_radius)
    if not state.any():
        raise InsufficientDataError("volume: expected samples with values inside the grid, got none")
    levels = voxels if kind == "float32" else _whole_levels(voxels, state, kind)
    return CompoundedVolume(levels.T, voxel_grid.spacing_mm, voxel_grid.world_from_grid, state=state.T)


def look_up_voxels(
    source: PosedImages, voxel_grid: VoxelGrid, reach_mm: float, region: BoolArray | None = None
) -> tuple[Float32Array, ByteArray]:
    """Interpolate each voxel of a sparse sweep between the nearest images on either side.

    Where images lie farther apart than voxels, samples put into voxels leave gaps, which hole filling closes
    with means of what is near. Here it is linear between two images, bilinear in either.

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
        `EMPTY`, `MEASURED` or `FILLED` of `speckle3d.core.volume`.

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
    voxels, state = nearest.blend(0.5 * float(np.abs(normals @ steps).max()))
    return voxels.reshape(n_k, n_j, n_i), state.reshape(n_k, n_j, n_i)


def _whole_levels(voxels: Float32Array, state: ByteArray, voxel_type: VoxelType) -> npt.NDArray[Any]:
    """Voxels rounded and clipped to a type of whole numbers, empty ones 0."""
    limits, out = np.iinfo(voxel_type), np.empty(voxels.shape, voxel_type)

    def work(first: int, stop: int) -> None:
        for k in range(first, stop):
            out[k] = np.clip(np.rint(np.where(state[k] > 0, voxels[k], 0)), limits.min, limits.max)

    in_parallel(work, len(voxels))
    return out
