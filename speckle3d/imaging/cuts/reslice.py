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


def reslice_at(
    images: Images,
    grid: ImageGrid,
    cuts: Sequence[tuple[RigidTransform, Cut]],
    max_distance_mm: float,
    region: BoolArray | None = None,
) -> list[Float32Array]:
    """Cut planes or curved sheets through a sweep's images, each at poses of its own.

    One pass over the images, in any order, with memory for the cuts and a few images; images too far from
    all cuts are not even read. A pixel between two images is interpolated linearly by its distances to
    their planes; with support on one side only it takes that image's level.

    Parameters
    ----------
    images : indexable or callable
        Grey images by frame number, shape (vector, sample); see `speckle3d.imaging.images.Images`.
    grid : ImageGrid
    cuts : sequence of RigidTransform, length n, and Cut
        World from image of every frame, and what is cut there.
    max_distance_mm : float
        Images this far from a pixel or farther do not count: about the distance between frames.
    region : ndarray of bool, shape (vector, sample), optional
        Samples of the images that count; by default all.

    Returns
    -------
    list of ndarray of float32, shape (rows, columns)
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
    targets = [
        NearestImages(
            PosedImages(images, grid, poses), cut.lines(), cut.shape[0], cut.hull_mm, max_distance_mm
        )
        for poses, cut in cuts
    ]
    look_up(targets, region)
    return [np.ascontiguousarray(points.blend()[0].T) for points in targets]
