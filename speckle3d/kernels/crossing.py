"""Looking up points in images that follow a bent path."""

from __future__ import annotations

import math

from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray


@njit(cache=True, nogil=True, inline="always", fastmath=False)
def _local(pose, p0, p1, p2, row):  # type: ignore[no-untyped-def]
    return pose[row, 0] * p0 + pose[row, 1] * p1 + pose[row, 2] * p2 + pose[row, 3]


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
    linearly. Where the point lies outside, or beside a NaN, the value and its slopes are NaN.

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
        Per mm, along the path's axes; empty if they are not wanted.
    """
    many, wide, high = volume.shape
    with_slopes = slopes.shape[0] > 0
    at = many // 2
    for i in range(points.shape[0]):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        values[i] = math.nan
        place[i] = math.nan
        if with_slopes:
            slopes[i] = math.nan
        at = min(max(at, 0), many - 2)
        d = _local(planes[at], p0, p1, p2, 2)
        # The planes are in order along the path; neighbouring points lie near each other.
        while d < 0.0 and at > 0:
            at -= 1
            d = _local(planes[at], p0, p1, p2, 2)
        if d < 0.0:
            continue
        after = _local(planes[at + 1], p0, p1, p2, 2)
        while after >= 0.0 and at < many - 2:
            at += 1
            d = after
            after = _local(planes[at + 1], p0, p1, p2, 2)
        if after > 0.0 or d - after <= 0.0:
            continue
        gap = d - after
        f = d / gap
        x, y = _local(planes[at], p0, p1, p2, 0), _local(planes[at], p0, p1, p2, 1)
        dx = _local(planes[at + 1], p0, p1, p2, 0) - x
        dy = _local(planes[at + 1], p0, p1, p2, 1) - y
        u = (x + f * dx - pixels[2]) / pixels[0]
        v = (y + f * dy - pixels[3]) / pixels[1]
        if not (0.0 <= u <= wide - 1.0 and 0.0 <= v <= high - 1.0):
            continue
        iu, iv = min(int(u), wide - 2), min(int(v), high - 2)
        a, b = u - iu, v - iv
        c00 = volume[at, iu, iv] * (1 - f) + volume[at + 1, iu, iv] * f
        c01 = volume[at, iu, iv + 1] * (1 - f) + volume[at + 1, iu, iv + 1] * f
        c10 = volume[at, iu + 1, iv] * (1 - f) + volume[at + 1, iu + 1, iv] * f
        c11 = volume[at, iu + 1, iv + 1] * (1 - f) + volume[at + 1, iu + 1, iv + 1] * f
        near, far = c00 + b * (c01 - c00), c10 + b * (c11 - c10)
        values[i] = near + a * (far - near)
        place[i] = at + f
        if not with_slopes or math.isnan(values[i]):
            continue
        by_u = (far - near) / pixels[0]
        by_v = ((1 - a) * (c01 - c00) + a * (c11 - c10)) / pixels[1]
        lower = (1 - a) * ((1 - b) * volume[at, iu, iv] + b * volume[at, iu, iv + 1])
        lower += a * ((1 - b) * volume[at, iu + 1, iv] + b * volume[at, iu + 1, iv + 1])
        upper = (1 - a) * ((1 - b) * volume[at + 1, iu, iv] + b * volume[at + 1, iu, iv + 1])
        upper += a * ((1 - b) * volume[at + 1, iu + 1, iv] + b * volume[at + 1, iu + 1, iv + 1])
        by_f = upper - lower + by_u * dx + by_v * dy
        for axis in range(3):
            # f = d / (d - after), both of which are linear in the point.
            near_d, after_d = planes[at, 2, axis], planes[at + 1, 2, axis]
            moved = (near_d * (1 - f) + after_d * f) / gap
            x_axis = planes[at, 0, axis] * (1 - f) + planes[at + 1, 0, axis] * f
            y_axis = planes[at, 1, axis] * (1 - f) + planes[at + 1, 1, axis] * f
            slopes[i, axis] = by_u * x_axis + by_v * y_axis + by_f * moved
