"""Running means kept in whole grey levels, pixel by pixel, as IGSIO keeps them for PLUS and 3D Slicer.

A voxel holds its level, 0 to 255, and the weight of the pixels it has got, in steps of 1/256 pixel in 16
bits: up to 255 pixels and 255/256. Positions are those of `speckle3d.kernels.splatting`, of which only the
14 bits behind the point are used that IGSIO has; so are shares of a pixel.
"""

import numpy as np
import numpy.typing as npt
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import ByteArray, IntArray
from speckle3d.kernels.samples import PLUS_BITS, POSITION_BITS, Samples
from speckle3d.kernels.splatting import cut_to_box

_DROPPED = POSITION_BITS - PLUS_BITS
_ONE = 1 << PLUS_BITS
_HALF = _ONE >> 1
_FRACTION = (1 << POSITION_BITS) - 1
_PIXEL = 256
"""Weight of a pixel."""
_MOST = 65535
"""Largest weight, where 16 bits end: more is cut to it."""
_TO_WEIGHT = PLUS_BITS - 8
"""Bits by which a share is finer than a weight."""

Weights = npt.NDArray[np.uint16]


@register_jitable(fastmath=False, error_model="numpy")
def _share(x: int, above: int) -> int:
    """Share, of 2^14, of a position that goes to the voxel above or below it."""
    fraction = (x & _FRACTION) >> _DROPPED
    return fraction if above else _ONE - fraction


@register_jitable(fastmath=False, error_model="numpy")
def _within(x: int, voxels: int) -> bool:
    """Whether both voxels beside a position are in the grid; one that lies on a voxel needs no other."""
    return x >= 0 and (x + _FRACTION) >> POSITION_BITS < voxels


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def add_whole(samples: Samples, box: IntArray, levels: ByteArray, weights: Weights) -> None:
    """Move the means of voxels by the pixels that lie in them or around them, to whole levels each time.

    With nearest, a mean is cut after every pixel, so that it can only fall below the exact one, and voxels
    with 255 pixels get no more weight: from then on each pixel moves the mean 1/256 of the way.

    With linear, a mean is rounded after every pixel, so that one that moves it by less than half a level does
    not count. A pixel counts nowhere unless all the voxels that it has a share in are in the grid. Weights
    that are full stay so; a share below 1/512 adds none.

    Parameters
    ----------
    samples : Samples
        Of uint8, lines are rows, in the order in which they count; all weights are one. Positions are whole
        multiples of 2^-14 voxel, not ahead where they are shared out.
    box : ndarray, shape (3, 2)
        First voxel and end along i, j and k; others are left alone.
    levels : ndarray, shape (n_k, n_j, n_i), changed in place
    weights : ndarray, shape (n_k, n_j, n_i), changed in place
        Units of 1/256 pixel.
    """
    images, _, maps, spans, _, linear = samples
    n_k, n_j, n_i = levels.shape
    for n in range(images.shape[0]):
        m = maps[n]
        for span in range(spans.shape[0]):
            row, start, stop, x, y, z = cut_to_box(spans[span], m, box, int(linear))
            for column in range(start, stop):
                level = np.int64(images[n, row, column])
                i, j, k = x >> POSITION_BITS, y >> POSITION_BITS, z >> POSITION_BITS
                if not linear:
                    mean, weight = np.int64(levels[k, j, i]), np.int64(weights[k, j, i])
                    if weight + _PIXEL <= _MOST:
                        levels[k, j, i] = (level * _PIXEL + mean * weight) // (weight + _PIXEL)
                        weights[k, j, i] = weight + _PIXEL
                    else:
                        levels[k, j, i] = (level + 255 * mean) >> 8
                elif _within(x, n_i) and _within(y, n_j) and _within(z, n_k):
                    for corner in range(8):
                        u, v, w = corner & 1, corner >> 1 & 1, corner >> 2
                        share = (_share(y, v) * _share(z, w) + _HALF) >> PLUS_BITS
                        share = (_share(x, u) * share + _HALF) >> PLUS_BITS
                        if (
                            share == 0
                            or not box[0, 0] <= i + u < box[0, 1]
                            or not box[1, 0] <= j + v < box[1, 1]
                            or not box[2, 0] <= k + w < box[2, 1]
                        ):
                            continue
                        at = (k + w, j + v, i + u)
                        before = np.int64(weights[at]) << _TO_WEIGHT
                        total = share * level + before * np.int64(levels[at])
                        # To the nearest 2^-14 of a level, halves to even, and only then to a whole one.
                        fine = np.int64(np.rint(total / (share + before) * _ONE))
                        levels[at] = (fine + _HALF) >> PLUS_BITS
                        after = (share + before + (1 << _TO_WEIGHT >> 1)) >> _TO_WEIGHT
                        weights[at] = after if after < _MOST else _MOST
                x, y, z = x + m[0, 1], y + m[1, 1], z + m[2, 1]
