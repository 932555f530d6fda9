"""Looking up points in images that follow a bent path."""

import math

from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.kernels.slicing import bilinear, coordinates


@njit(cache=True, nogil=True, fastmath=False)
def look_up(
    points: FloatArray,
    volume: Float32Array,
    planes: FloatArray,
    pixels: FloatArray,
    values: FloatArray,
    slopes: FloatArray,
    place: FloatArray,
) -> None:
    """Fill ``values`` with the grey level at each point and ``slopes`` with its change with the point.

    Between two neighbouring planes a point's coordinates in them, and the grey levels, are interpolated
    linearly. Where the point lies outside, or beside a NaN, the value is NaN.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        In the frame of the planes' path, mm.
    volume : ndarray, shape (k, u, v)
        Images of the planes.
    planes : ndarray, shape (k, 3, 4)
        Plane from path: the point's x, y and distance from each plane, which falls from plane to plane.
    pixels : ndarray, shape (4,)
        Pixel size along u and v, and where the first pixel lies, mm.
    values, place : ndarray, shape (n,)
        Grey level, and number of the plane, with its fraction.
    slopes : ndarray, shape (n, 3)
        Per mm, along the path's axes; undefined where the value is NaN.
    """
    many, wide, high = volume.shape
    at = many // 2
    for i in range(points.shape[0]):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        values[i] = place[i] = math.nan
        # The planes are in order along the path; neighbouring points lie near each other.
        while at > 0 and coordinates(planes[at], p0, p1, p2)[2] < 0.0:
            at -= 1
        at = min(at, many - 2)
        while at < many - 2 and coordinates(planes[at + 1], p0, p1, p2)[2] >= 0.0:
            at += 1
        x, y, d = coordinates(planes[at], p0, p1, p2)
        after_x, after_y, after = coordinates(planes[at + 1], p0, p1, p2)
        if d < 0.0 or after > 0.0 or d - after <= 0.0:
            continue
        gap = d - after
        f = d / gap
        dx, dy = after_x - x, after_y - y
        u, v = (x + f * dx - pixels[2]) / pixels[0], (y + f * dy - pixels[3]) / pixels[1]
        if not (0.0 <= u <= wide - 1.0 and 0.0 <= v <= high - 1.0):
            continue
        near, near_u, near_v = bilinear(volume[at], u, v)
        far, far_u, far_v = bilinear(volume[at + 1], u, v)
        values[i] = near + f * (far - near)
        place[i] = at + f
        by_u, by_v = (near_u + f * (far_u - near_u)) / pixels[0], (near_v + f * (far_v - near_v)) / pixels[1]
        by_f = far - near + by_u * dx + by_v * dy
        for axis in range(3):
            # f = d / (d - after), both of which are linear in the point.
            a, b = planes[at, :, axis], planes[at + 1, :, axis]
            slopes[i, axis] = (
                by_u * (a[0] * (1 - f) + b[0] * f)
                + by_v * (a[1] * (1 - f) + b[1] * f)
                + by_f * (a[2] * (1 - f) + b[2] * f) / gap
            )
