"""Reslices: any plane or curved sheet through a sweep, straight from its frames.

Resliced from the frames, each pixel blends the two images nearest to it, one on either side, sampled
bilinearly where the pixel projects onto them: no voxels, no hole filling, and the images' own resolution.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, Float32Array
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.cuts.planes import Cut
from speckle3d.imaging.images import Images, PosedImages
from speckle3d.imaging.nearest import NearestImages, look_up


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
    region: BoolArray | None = None,
) -> list[Float32Array]:
    """Make several cuts, each at poses of its own, in one pass over the images; else as `reslice_frames`.

    Of the images only samples of a region count, shape (vector, sample).
    """
    sought = [
        NearestImages(
            PosedImages(images, grid, poses), cut.lines(), cut.shape[0], cut.hull_mm, max_distance_mm
        )
        for poses, cut in wanted
    ]
    look_up(sought, region)
    return [np.ascontiguousarray(points.blended()[0].T) for points in sought]
