"""Cuts through posed images, along straight lines of evenly spaced points.

Each line starts at a point of the world and takes equal steps, so that what an image can reach of it is one
stretch.
"""

import math

import numpy as np
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.kernels.slicing import bilinear

EDGE_TOLERANCE = 1e-6
"""Fraction of a pixel by which a point may miss the border: rounding of poses."""


@register_jitable(fastmath=False, error_model="numpy")
def _clip(
    first: float, last: float, start: float, step: float, low: float, high: float
) -> tuple[float, float]:
    """Shrink [first, last] to where ``low <= start + step * k <= high``, rounding aside."""
    if abs(step) < 1e-12:
        inside = low - EDGE_TOLERANCE <= start <= high + EDGE_TOLERANCE
        return (first, last) if inside else (1.0, 0.0)
    a, b = (low - start) / step, (high - start) / step
    return max(first, min(a, b)), min(last, max(a, b))


@register_jitable(fastmath=False, error_model="numpy")
def _coordinate(matrix: FloatArray, row: int, point: FloatArray) -> tuple[float, float]:
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
        u, du = _coordinate(index_from_world, 0, lines[line])
        v, dv = _coordinate(index_from_world, 1, lines[line])
        q, dq = _coordinate(index_from_world, 2, lines[line])
        # Coordinates are linear along a line, so the points an image can reach are one interval.
        first, last = _clip(0.0, points - 1.0, q, dq, -max_distance_mm, max_distance_mm)
        first, last = _clip(first, last, u, du, 0.0, image.shape[0] - 1.0)
        first, last = _clip(first, last, v, dv, 0.0, image.shape[1] - 1.0)
        if first > last + 2.0:
            continue
        for point in range(max(int(first) - 1, 0), min(int(last) + 2, points)):
            offset = q + dq * point
            side = 0 if offset >= 0.0 else 1
            away = np.float32(abs(offset))
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
