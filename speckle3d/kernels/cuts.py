"""Cuts through posed images and through voxels, along straight lines of evenly spaced points.

A plane is cut along its rows, a curved sheet along its columns. Each line starts at a point of the world and
takes equal steps, so that what an image or a volume can reach of it is one stretch.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray, IntArray
from speckle3d.core.labels import EMPTY, FILLED, MEASURED
from speckle3d.kernels.slicing import bilinear

EDGE_TOLERANCE = 1e-6
"""Fraction of a pixel or voxel by which a point may miss the border: rounding of poses."""


@njit(cache=True, inline="always", error_model="numpy", fastmath=False)
def _clip(first: float, last: float, start: float, step: float, low: float, high: float):  # type: ignore[no-untyped-def]
    """Shrink [first, last] to where ``low <= start + step * k <= high``, rounding aside."""
    if abs(step) < 1e-12:
        inside = low - EDGE_TOLERANCE <= start <= high + EDGE_TOLERANCE
        return (first, last) if inside else (1.0, 0.0)
    a, b = (low - start) / step, (high - start) / step
    return max(first, min(a, b)), min(last, max(a, b))


@njit(cache=True, inline="always", error_model="numpy", fastmath=False)
def _mapped(matrix, row, point):  # type: ignore[no-untyped-def]
    """One coordinate of a point of the world, and its change with the line's step."""
    start = matrix[row, 3]
    step = 0.0
    for axis in range(3):
        start += matrix[row, axis] * point[0, axis]
        step += matrix[row, axis] * point[1, axis]
    return start, step


# One thread: an image takes a fraction of a millisecond, and a team of threads gathered anew for each image
# waits far longer than that as soon as another process wants a core.
@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def keep_nearest(
    image: Float32Array,
    index_from_world: FloatArray,
    lines: FloatArray,
    max_distance_mm: float,
    distance_mm: Float32Array,
    grey: Float32Array,
) -> None:
    """Let one image replace, on either of its sides, farther images in the points of a cut.

    Parameters
    ----------
    image : ndarray, shape (vector, sample)
    index_from_world : ndarray, shape (3, 4)
        To (vector, sample, signed distance from the image's plane in mm).
    lines : ndarray, shape (n, 2, 3)
        Of each line the first point and the step to the next one, mm in the world.
    distance_mm, grey : ndarray, shape (2, n, points), changed in place
        Of the nearest image so far behind ([0], distance >= 0) and in front ([1]) of each point. Where there
        is none yet, `distance_mm` holds `max_distance_mm`.
    """
    points = grey.shape[2]
    for line in range(lines.shape[0]):
        u, du = _mapped(index_from_world, 0, lines[line])
        v, dv = _mapped(index_from_world, 1, lines[line])
        q, dq = _mapped(index_from_world, 2, lines[line])
        # Coordinates are linear along a line, so the points an image can reach are one interval.
        first, last = _clip(0.0, points - 1.0, q, dq, -max_distance_mm, max_distance_mm)
        first, last = _clip(first, last, u, du, 0.0, image.shape[0] - 1.0)
        first, last = _clip(first, last, v, dv, 0.0, image.shape[1] - 1.0)
        if first > last + 2.0:
            continue
        for point in range(max(int(first) - 1, 0), min(int(last) + 2, points)):
            signed = q + dq * point
            side = 0 if signed >= 0.0 else 1
            away = np.float32(abs(signed))
            if away < distance_mm[side, line, point]:
                at_u, at_v = u + du * point, v + dv * point
                if not (-EDGE_TOLERANCE <= at_u <= image.shape[0] - 1 + EDGE_TOLERANCE):
                    continue
                if not (-EDGE_TOLERANCE <= at_v <= image.shape[1] - 1 + EDGE_TOLERANCE):
                    continue
                at_u = min(max(at_u, 0.0), image.shape[0] - 1.0)
                at_v = min(max(at_v, 0.0), image.shape[1] - 1.0)
                level, _, _ = bilinear(image, at_u, at_v)
                if not math.isnan(level):
                    distance_mm[side, line, point] = away
                    grey[side, line, point] = level


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def blend_nearest(
    distance_mm: Float32Array, grey: Float32Array, alone_mm: float, levels: Float32Array, state: ByteArray
) -> None:
    """Interpolate between the nearest images of either side, or take the only one there is if it is near.

    Parameters
    ----------
    distance_mm, grey : ndarray, shape (2, n, points)
        As `keep_nearest` leaves them; `grey` is NaN where there is no image.
    alone_mm : float
        Distance of an image up to which a point is measured, and to which one image alone counts.
    levels : ndarray, shape (n, points), filled
        NaN where nothing is near.
    state : ndarray, shape (n, points), filled
        `EMPTY`, `MEASURED` or, between two images farther away, `FILLED`.
    """
    for line in range(levels.shape[0]):
        for point in range(levels.shape[1]):
            behind, front = distance_mm[0, line, point], distance_mm[1, line, point]
            level, other = grey[0, line, point], grey[1, line, point]
            none_behind, none_front = math.isnan(level), math.isnan(other)
            measured = (behind <= alone_mm and not none_behind) or (front <= alone_mm and not none_front)
            if not measured and (none_behind or none_front):
                levels[line, point], state[line, point] = np.nan, EMPTY
                continue
            state[line, point] = MEASURED if measured else FILLED
            if none_behind:
                level = other
            elif not none_front and behind > 0:
                level += behind / (behind + front) * (other - level)
            levels[line, point] = level


@njit(cache=True, inline="always", error_model="numpy", fastmath=False)
def _neighbours(at, last, stride):  # type: ignore[no-untyped-def]
    """Where the lower neighbour along an axis is, weight of the upper one, and how far it is on, if asked."""
    at = min(max(at, 0.0), last)
    lower = int(at)
    share = at - lower
    # On a voxel but for rounding, its neighbours do not count: they may be outside, or hold nothing.
    if share < EDGE_TOLERANCE:
        share = 0.0
    elif share > 1.0 - EDGE_TOLERANCE:
        lower, share = lower + 1, 0.0
    return lower * stride, share, stride if share > 0.0 else 0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def cut_voxels(
    voxels: npt.NDArray[np.generic],
    state: ByteArray,
    strides: IntArray,
    sides: IntArray,
    index_from_world: FloatArray,
    lines: FloatArray,
    out: Float32Array,
) -> None:
    """Sample voxels trilinearly along lines; NaN outside, and where voxels of most weight hold nothing.

    Parameters
    ----------
    voxels : ndarray, shape (n_i * n_j * n_k,)
        In any order in memory.
    state : ndarray, shape (n_i * n_j * n_k,) or (0,)
        `EMPTY` where a voxel holds nothing; without it, those hold nothing that are NaN.
    strides, sides : ndarray, shape (3,)
        Distance in `voxels` between neighbours along i, j and k, and number of them.
    index_from_world : ndarray, shape (3, 4)
    lines : ndarray, shape (n, 2, 3)
        Of each line the first point and the step to the next one, mm in the world.
    out : ndarray, shape (n, points), filled
    """
    points = out.shape[1]
    stated = state.shape[0] > 0
    last_i, last_j, last_k = sides[0] - 1.0, sides[1] - 1.0, sides[2] - 1.0
    for line in range(lines.shape[0]):
        u, du = _mapped(index_from_world, 0, lines[line])
        v, dv = _mapped(index_from_world, 1, lines[line])
        w, dw = _mapped(index_from_world, 2, lines[line])
        begin, end = _clip(0.0, points - 1.0, u, du, -EDGE_TOLERANCE, last_i + EDGE_TOLERANCE)
        begin, end = _clip(begin, end, v, dv, -EDGE_TOLERANCE, last_j + EDGE_TOLERANCE)
        begin, end = _clip(begin, end, w, dw, -EDGE_TOLERANCE, last_k + EDGE_TOLERANCE)
        out[line] = np.nan
        if begin > end:
            continue
        first, stop = math.ceil(begin), int(end) + 1
        for point in range(first, stop):
            i, a, step_i = _neighbours(u + du * point, last_i, strides[0])
            j, b, step_j = _neighbours(v + dv * point, last_j, strides[1])
            k, c, step_k = _neighbours(w + dw * point, last_k, strides[2])
            at = i + j + k
            if stated:
                level = _counted(voxels, state, at, step_i, step_j, step_k, a, b, c)
            else:
                level = _plane_of(voxels, at, step_i, step_j, a, b)
                level += c * (_plane_of(voxels, at + step_k, step_i, step_j, a, b) - level)
                if math.isnan(level):
                    level = _counted(voxels, state, at, step_i, step_j, step_k, a, b, c)
            out[line, point] = level


@njit(cache=True, inline="always", error_model="numpy", fastmath=False)
def _plane_of(voxels, at, step_i, step_j, a, b):  # type: ignore[no-untyped-def]
    """Level between four voxels."""
    near, far = float(voxels[at]), float(voxels[at + step_j])
    near += a * (float(voxels[at + step_i]) - near)
    far += a * (float(voxels[at + step_i + step_j]) - far)
    return near + b * (far - near)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _counted(
    voxels: npt.NDArray[np.generic],
    state: ByteArray,
    at: int,
    step_i: int,
    step_j: int,
    step_k: int,
    a: float,
    b: float,
    c: float,
) -> float:
    """Mean of those of eight voxels that hold something, by their weights; NaN if these are under a half."""
    total = 0.0
    weights = 0.0
    for corner in range(8):
        weight = a if corner & 1 else 1.0 - a
        weight *= b if corner & 2 else 1.0 - b
        weight *= c if corner & 4 else 1.0 - c
        place = at
        if corner & 1:
            place += step_i
        if corner & 2:
            place += step_j
        if corner & 4:
            place += step_k
        level = float(voxels[place])
        if math.isnan(level) or (state.shape[0] > 0 and state[place] == EMPTY):
            continue
        total += weight * level
        weights += weight
    return total / weights if weights >= 0.5 - EDGE_TOLERANCE else math.nan
