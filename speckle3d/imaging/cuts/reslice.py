"""Reslices: any plane or curved sheet through a sweep, straight from its frames or from voxels.

Resliced from the frames, each pixel blends the two images nearest to it, one on either side, sampled
bilinearly where the pixel projects onto them: no voxels, no hole filling, and the images' own resolution.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import ByteArray, Float32Array
from speckle3d.core.errors import MismatchError
from speckle3d.core.sweep import ImageGrid
from speckle3d.core.threads import in_parallel
from speckle3d.core.volume import Volume
from speckle3d.imaging.cuts.planes import Cut, image_plane
from speckle3d.imaging.cuts.planes import ReslicePlane as ReslicePlane
from speckle3d.imaging.images import ChosenImages, Images, PosedImages
from speckle3d.imaging.nearest import NearestImages, look_up

_GRAIN = 32
"""Lines of a cut below which a slice is not worth another thread's while."""


def reslice_frames(
    images: Images,
    grid: ImageGrid,
    world_from_image: RigidTransform,
    cut: Cut,
    max_distance_mm: float,
) -> Float32Array:
    """Cut a plane or a curved sheet through a sweep's images.

    One pass over the images, in any order, with memory for the cut and a few images; images too far from
    the cut are not even read. A pixel between two images is interpolated linearly by its distances to
    their planes; with support on one side only it takes that image's level.

    Parameters
    ----------
    images : indexable or callable
        Grey images by frame number, shape (vector, sample); see `speckle3d.imaging.images.Images`.
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    cut : ReslicePlane or CurvedSheet
    max_distance_mm : float
        Images this far from a pixel or farther do not count: about the distance between frames.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
        NaN where no image is near enough.

    Raises
    ------
    InvalidInputError
        If `max_distance_mm` is not positive, or images and poses do not fit together.

    References
    ----------
    .. [1] W. Wein et al., "Backward-warping ultrasound reconstruction for improving diagnostic value and
       registration", MICCAI, 2006.
    """
    return reslice_at(images, grid, [(world_from_image, cut)], max_distance_mm)[0]


def reslice_at(
    images: Images,
    grid: ImageGrid,
    wanted: Sequence[tuple[RigidTransform, Cut]],
    max_distance_mm: float,
) -> list[Float32Array]:
    """Make several cuts, each at poses of its own, in one pass over the images; else as `reslice_frames`."""
    sought = [
        NearestImages(
            PosedImages(images, grid, poses), cut.lines(), cut.shape[0], cut.hull_mm, max_distance_mm
        )
        for poses, cut in wanted
    ]
    look_up(sought)
    return [np.ascontiguousarray(each.blended()[0].T) for each in sought]


def resample_image(images: Images, frame: int, grid: ImageGrid, pixel_mm: float) -> Float32Array:
    """One image on square pixels, as a reslice through its own plane shows it.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
    """
    plane = image_plane(RigidTransform.identity(), grid, pixel_mm)
    alone = ChosenImages(images, np.array([frame]))
    return reslice_frames(alone, grid, RigidTransform.identity(1), plane, 1.0)


def reslice_volume(volume: Volume, cut: Cut, state: ByteArray | None = None) -> Float32Array:
    """Cut a plane or a curved sheet through voxels, linear between them.

    Voxels that hold nothing do not count: a pixel is the mean of its other neighbours by their weights, and
    nothing if those have less than half of all.

    Parameters
    ----------
    volume : Volume
    cut : ReslicePlane or CurvedSheet
    state : ndarray of uint8, shape (n_i, n_j, n_k), optional
        0 where a voxel holds nothing. Without it, those hold nothing that are NaN; in volumes of integers
        all count, a level of 0 as well.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
        NaN outside the volume, and where it holds nothing.

    Raises
    ------
    MismatchError
        If voxels and their states differ in shape.
    """
    from speckle3d.kernels.cuts import cut_voxels

    if state is not None and state.shape != volume.shape:
        raise MismatchError(f"state: expected shape {volume.shape}, got {state.shape}")
    held = np.empty((0, 0, 0), np.uint8) if state is None else state.astype(np.uint8, copy=False)
    index_from_world = np.asarray(np.linalg.inv(volume.world_from_index)[:3], dtype=float)
    lines = cut.lines()
    out = np.empty((len(lines), cut.shape[0]), np.float32)

    def fill(first: int, stop: int) -> None:
        band = slice(first, stop)
        cut_voxels(volume.voxels.T, held.T, index_from_world, lines[band], out[band])

    in_parallel(fill, len(lines), _GRAIN)
    return np.ascontiguousarray(out.T)
