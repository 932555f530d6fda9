"""Cuts through posed images and through voxels, along straight lines of evenly spaced points.

A plane is cut along its rows, a curved sheet along its columns. Each line starts at a point of the world and
takes equal steps, so that what an image or a volume can reach of it is one stretch.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from speckle3d.core.arrays import ByteArray, Float32Array, FloatArray
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _neighbours(at: float, last: int) -> tuple[np.uint64, np.uint64, float]:
    """Lower and upper neighbour along an axis, and weight of the upper one."""
    at = min(max(at, 0.0), float(last))
    lower = int(at)
    share = at - lower
    # On a voxel but for rounding, its neighbours do not count: they may be outside, or hold nothing.
    if share > 1.0 - EDGE_TOLERANCE:
        lower, share = lower + 1, 0.0
    upper = lower + (share >= EDGE_TOLERANCE)
    # Unsigned, which no compiler takes for an index from the end.
    return np.uint64(lower), np.uint64(upper), share if share >= EDGE_TOLERANCE else 0.0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _between(near: float, far: float, share: float) -> float:
    return (1.0 - share) * near + share * far


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def cut_voxels(
    voxels: npt.NDArray[np.generic],
    state: ByteArray,
    index_from_world: FloatArray,
    lines: FloatArray,
    out: Float32Array,
) -> None:
    """Sample voxels trilinearly along lines; NaN outside, and where voxels of most weight hold nothing.

    Parameters
    ----------
    voxels : ndarray, shape (n_k, n_j, n_i)
        In any order in memory, fastest in C order.
    state : ndarray, shape (n_k, n_j, n_i) or (0, 0, 0)
        `EMPTY` where a voxel holds nothing; without it, those hold nothing that are NaN.
    index_from_world : ndarray, shape (3, 4)
    lines : ndarray, shape (n, 2, 3)
        Of each line the first point and the step to the next one, mm in the world.
    out : ndarray, shape (n, points), filled
    """
    stated = state.size > 0
    last_i, last_j, last_k = voxels.shape[2] - 1, voxels.shape[1] - 1, voxels.shape[0] - 1
    for line in range(lines.shape[0]):
        u, du = _mapped(index_from_world, 0, lines[line])
        v, dv = _mapped(index_from_world, 1, lines[line])
        w, dw = _mapped(index_from_world, 2, lines[line])
        begin, end = _clip(0.0, out.shape[1] - 1.0, u, du, -EDGE_TOLERANCE, last_i + EDGE_TOLERANCE)
        begin, end = _clip(begin, end, v, dv, -EDGE_TOLERANCE, last_j + EDGE_TOLERANCE)
        begin, end = _clip(begin, end, w, dw, -EDGE_TOLERANCE, last_k + EDGE_TOLERANCE)
        out[line] = np.nan
        if begin > end:
            continue
        for point in range(math.ceil(begin), int(end) + 1):
            i, far_i, a = _neighbours(u + du * point, last_i)
            j, far_j, b = _neighbours(v + dv * point, last_j)
            k, far_k, c = _neighbours(w + dw * point, last_k)
            if not stated:
                near = _between(voxels[k, j, i], voxels[k, j, far_i], a)
                near = _between(near, _between(voxels[k, far_j, i], voxels[k, far_j, far_i], a), b)
                far = _between(voxels[far_k, j, i], voxels[far_k, j, far_i], a)
                far = _between(far, _between(voxels[far_k, far_j, i], voxels[far_k, far_j, far_i], a), b)
                level = _between(near, far, c)
                if not math.isnan(level):
                    out[line, point] = level
                    continue
            total, weights = 0.0, 0.0
            for corner in range(8):
                weight = a if corner & 1 else 1.0 - a
                weight *= b if corner & 2 else 1.0 - b
                weight *= c if corner & 4 else 1.0 - c
                place = far_k if corner & 4 else k, far_j if corner & 2 else j, far_i if corner & 1 else i
                level = float(voxels[place])
                if not math.isnan(level) and not (stated and state[place] == EMPTY):
                    total += weight * level
                    weights += weight
            if weights >= 0.5 - EDGE_TOLERANCE:
                out[line, point] = total / weights
