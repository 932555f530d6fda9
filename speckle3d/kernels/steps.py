"""How an image that rides on a sensor moves from one time to another, by the sensor's readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray

_STILL_RAD = 1e-12


class Readings(NamedTuple):
    """A sensor's readings and its mounting, quaternions with the scalar last.

    Attributes
    ----------
    time_s : float64, shape (r,)
        Increasing.
    turned : float64, shape (r, 4)
    moved : float64, shape (r, 3)
    mounting_turned : float64, shape (4,)
    mounting_moved : float64, shape (3,)
    """

    time_s: FloatArray
    turned: FloatArray
    moved: FloatArray
    mounting_turned: FloatArray
    mounting_moved: FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def steps_of_readings(
    readings: Readings, centre_mm: FloatArray, first_s: FloatArray, second_s: FloatArray, out: FloatArray
) -> None:
    """Fill `out` with the motion of a point of the image between two times, seen from the first.

    Readings are interpolated: translations linearly, rotations by slerp.

    Parameters
    ----------
    readings : Readings
    centre_mm : float64, shape (3,)
        The point.
    first_s, second_s : float64, shape (m,)
        On the sensor's clock; NaN where the sensor has no reading.
    out : float64, shape (m, 6)
        x, y, z of the point, mm, and the rotation vector, degrees; NaN where a time is.
    """
    q, p, u, v = np.empty((2, 4)), np.empty((2, 3)), np.empty(4), np.empty(3)
    for m in range(first_s.size):
        if np.isnan(first_s[m]) or np.isnan(second_s[m]):
            out[m] = np.nan
            continue
        _pose_at(readings, first_s[m], q[0], p[0])
        _pose_at(readings, second_s[m], q[1], p[1])
        q[0, :3] = -q[0, :3]
        # x = R1' (p2 + R2 c - p1) - c
        _turn(q[1], centre_mm, v)
        for k in range(3):
            v[k] += p[1, k] - p[0, k]
        _turn(q[0], v, out[m, :3])
        for k in range(3):
            out[m, k] -= centre_mm[k]
        _multiply(q[0], q[1], u)
        norm = np.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
        angle = 2.0 * np.arctan2(norm, abs(u[3]))
        size = np.rad2deg(angle / norm if norm > _STILL_RAD else 2.0) * (-1.0 if u[3] < 0.0 else 1.0)
        for k in range(3):
            out[m, 3 + k] = size * u[k]


@njit(error_model="numpy")
def _pose_at(readings: Readings, time_s: float, q: FloatArray, p: FloatArray) -> None:
    """Rotation and place of the image at a time."""
    time, turned, moved = readings.time_s, readings.turned, readings.moved
    k = max(min(int(np.searchsorted(time, time_s)), time.size - 1), 1) - 1
    after = min(k + 1, time.size - 1)
    part = (time_s - time[k]) / (time[after] - time[k]) if after > k else 0.0
    apart, across, along = 0.0, 0.0, 0.0
    for j in range(4):
        apart += turned[k, j] * turned[after, j]
    side = -1.0 if apart < 0.0 else 1.0
    for j in range(4):
        across += (side * turned[after, j] - turned[k, j]) ** 2
        along += (side * turned[after, j] + turned[k, j]) ** 2
    angle = 2.0 * np.arctan2(np.sqrt(across), np.sqrt(along))
    before = 1.0 - part
    if angle > _STILL_RAD:
        before, part_of_turn = np.sin(before * angle) / np.sin(angle), np.sin(part * angle) / np.sin(angle)
    else:
        part_of_turn = part
    sensor = np.empty(4)
    for j in range(4):
        sensor[j] = before * turned[k, j] + side * part_of_turn * turned[after, j]
    _multiply(sensor, readings.mounting_turned, q)
    _turn(sensor, readings.mounting_moved, p)
    for j in range(3):
        p[j] += moved[k, j] + part * (moved[after, j] - moved[k, j])


@njit(error_model="numpy")
def _multiply(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    out[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    out[1] = a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0]
    out[2] = a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3]
    out[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]


@njit(error_model="numpy")
def _turn(q: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """Turn a vector by a unit quaternion."""
    x = 2.0 * (q[1] * v[2] - q[2] * v[1])
    y = 2.0 * (q[2] * v[0] - q[0] * v[2])
    z = 2.0 * (q[0] * v[1] - q[1] * v[0])
    a = v[0] + q[3] * x + q[1] * z - q[2] * y
    b = v[1] + q[3] * y + q[2] * x - q[0] * z
    out[2] = v[2] + q[3] * z + q[0] * y - q[1] * x
    out[0], out[1] = a, b
