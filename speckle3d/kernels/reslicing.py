"""Cutting a plane through posed images without a volume in between."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray

EDGE_TOLERANCE = 1e-6
"""Fraction of a pixel by which a point may miss the image's border: rounding of poses, not geometry."""


@njit(cache=True, inline="always")
def _clip(first: float, last: float, start: float, step: float, low: float, high: float):  # type: ignore[no-untyped-def]
    """Shrink [first, last] to where ``low <= start + step * k <= high``, rounding aside."""
    if abs(step) < 1e-12:
        inside = low - 1e-6 <= start <= high + 1e-6
        return (first, last) if inside else (1.0, 0.0)
    a, b = (low - start) / step, (high - start) / step
    return max(first, min(a, b)), min(last, max(a, b))


@njit(cache=True, inline="always")
def bilinear(image: Float32Array, vector: float, sample: float) -> float:
    """Grey level between the four neighbours; NaN outside the image or beside a NaN."""
    vectors, samples = image.shape
    if not (-EDGE_TOLERANCE <= vector <= vectors - 1 + EDGE_TOLERANCE):
        return math.nan
    if not (-EDGE_TOLERANCE <= sample <= samples - 1 + EDGE_TOLERANCE):
        return math.nan
    i = min(max(int(vector), 0), max(vectors - 2, 0))
    j = min(max(int(sample), 0), max(samples - 2, 0))
    i1, j1 = min(i + 1, vectors - 1), min(j + 1, samples - 1)
    fi, fj = min(max(vector - i, 0.0), 1.0), min(max(sample - j, 0.0), 1.0)
    near = image[i, j] * (1.0 - fj) + image[i, j1] * fj
    far = image[i1, j] * (1.0 - fj) + image[i1, j1] * fj
    level: float = near * (1.0 - fi) + far * fi
    return level


# One thread: an image takes a fraction of a millisecond, and a team of threads gathered anew for each image
# waits far longer than that as soon as another process wants a core.
@njit(cache=True, nogil=True)
def keep_nearest(
    image: Float32Array,
    index_from_pixel: FloatArray,
    max_distance_mm: float,
    distance_mm: Float32Array,
    grey: Float32Array,
) -> None:
    """Let one image replace, on either of its sides, farther images in the pixels of a plane.

    Parameters
    ----------
    image : ndarray, shape (vector, sample)
    index_from_pixel : ndarray, shape (3, 3)
        From (column, row, 1) to (vector, sample, signed distance from the image's plane in mm).
    distance_mm, grey : ndarray, shape (2, rows, columns), changed in place
        Of the nearest image so far behind ([0], distance >= 0) and in front ([1]) of each pixel. Where there
        is none yet, `distance_mm` holds `max_distance_mm`.
    """
    rows, columns = grey.shape[1:]
    du, dv, dq = index_from_pixel[0, 0], index_from_pixel[1, 0], index_from_pixel[2, 0]
    for row in range(rows):
        u = index_from_pixel[0, 1] * row + index_from_pixel[0, 2]
        v = index_from_pixel[1, 1] * row + index_from_pixel[1, 2]
        q = index_from_pixel[2, 1] * row + index_from_pixel[2, 2]
        # Coordinates are linear along a row, so the columns an image can reach are one interval.
        first, last = _clip(0.0, columns - 1.0, q, dq, -max_distance_mm, max_distance_mm)
        first, last = _clip(first, last, u, du, 0.0, image.shape[0] - 1.0)
        first, last = _clip(first, last, v, dv, 0.0, image.shape[1] - 1.0)
        if first > last + 2.0:
            continue
        for column in range(max(int(first) - 1, 0), min(int(last) + 2, columns)):
            signed = q + dq * column
            side = 0 if signed >= 0.0 else 1
            away = np.float32(abs(signed))
            if away < distance_mm[side, row, column]:
                level = bilinear(image, u + du * column, v + dv * column)
                if not math.isnan(level):
                    distance_mm[side, row, column] = away
                    grey[side, row, column] = level
