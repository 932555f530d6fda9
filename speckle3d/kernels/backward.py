"""Voxels interpolated between the images nearest on either side."""

from __future__ import annotations

import numpy as np
from numba import njit

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray
from speckle3d.kernels.cuts import keep_nearest

# States of a voxel, as `speckle3d.imaging.holes` has them.
_EMPTY, _MEASURED, _FILLED = 0, 1, 2


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def keep_nearest_in_planes(
    image: Float32Array,
    index_from_voxel: FloatArray,
    reach_mm: float,
    first: int,
    distance_mm: Float32Array,
    grey: Float32Array,
) -> None:
    """Let one image replace, on either of its sides, farther images in the voxels of some planes.

    Parameters
    ----------
    image : ndarray, shape (vector, sample)
    index_from_voxel : ndarray, shape (3, 4)
        From (i, j, k, 1) to (vector, sample, signed distance from the image's plane in mm).
    reach_mm : float
        Images this far away or farther do not count.
    first : int
        k of the first plane.
    distance_mm, grey : ndarray, shape (planes, 2, n_j, n_i), changed in place
        See `keep_nearest`.
    """
    # The lines of a cut: along i, from (0, j, k), a voxel a step.
    lines = np.zeros((grey.shape[2], 2, 3))
    lines[:, 1, 0] = 1.0
    lines[:, 0, 1] = np.arange(grey.shape[2])
    for plane in range(grey.shape[0]):
        lines[:, 0, 2] = first + plane
        keep_nearest(image, index_from_voxel, lines, reach_mm, distance_mm[plane], grey[plane])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def blend_planes(
    distance_mm: Float32Array,
    grey: Float32Array,
    half_voxel_mm: float,
    voxels: Float32Array,
    state: ByteArray,
) -> None:
    """Interpolate voxels between the nearest images of either side.

    Parameters
    ----------
    distance_mm, grey : ndarray, shape (planes, 2, n_j, n_i)
        See `keep_nearest`; `grey` is NaN where there is no image.
    half_voxel_mm : float
        Distance of an image up to which a voxel is measured.
    voxels, state : ndarray, shape (planes, n_j, n_i), filled
    """
    for k in range(voxels.shape[0]):
        for j in range(voxels.shape[1]):
            for i in range(voxels.shape[2]):
                behind, front = distance_mm[k, 0, j, i], distance_mm[k, 1, j, i]
                level, other = grey[k, 0, j, i], grey[k, 1, j, i]
                near = np.float32(np.inf)
                if not np.isnan(level):
                    near = behind
                if not np.isnan(other):
                    near = min(near, front)
                between = not (np.isnan(level) or np.isnan(other))
                if near <= half_voxel_mm:
                    state[k, j, i] = _MEASURED
                elif between:
                    state[k, j, i] = _FILLED
                else:
                    state[k, j, i] = _EMPTY
                    voxels[k, j, i] = np.nan
                    continue
                if between:
                    gap = behind + front
                    share = behind / gap if gap > 0 else np.float32(0.0)
                    level += share * (other - level)
                elif np.isnan(level):
                    level = other
                voxels[k, j, i] = level
