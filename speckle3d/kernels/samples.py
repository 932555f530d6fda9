"""Samples of images on their way to voxels."""

from typing import Any, NamedTuple

import numpy.typing as npt

from speckle3d.core.arrays import FloatArray, IntArray

POSITION_BITS = 40
"""Bits of a position behind the point; 23 before it and a sign."""
SHARE_BITS = 10
"""Bits behind the point of a position between eight voxels."""
PLUS_BITS = 14
"""Bits of a place and of a share behind the point, where levels are kept as IGSIO keeps them."""


class Samples(NamedTuple):
    """Samples of several images, and where they lie.

    Attributes
    ----------
    images : ndarray, shape (n, line, sample)
        NaN does not count, nor does infinity with the mean of the nearest.
    weights : ndarray, shape (n,)
        Of each image; images of weight zero must be left out.
    maps : ndarray, shape (n, 3, 3)
        From (line, sample, 1) to positions (i, j, k) in units of 2^-40 voxel. Where samples count in the
        voxel they lie in, voxel n reaches from n to n + 1 whole ones. Where they are shared out, its centre
        is n, and positions are half of 2^-10 voxel ahead: shares are of positions rounded to 2^-10 voxel.
    spans : ndarray, shape (m, 3)
        Line, first sample and end of what is used of every image.
    first_tag : int
        With 0 all images count; else the last that has a sample in a voxel: this is the first one's tag, and
        the others' follow.
    linear : bool
        Whether samples are shared out to the eight voxels around them.
    """

    images: npt.NDArray[Any]
    weights: FloatArray
    maps: IntArray
    spans: IntArray
    first_tag: int
    linear: bool
