"""How an image that rides on a sensor moves from one time to another, by the sensor's readings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray

_STILL_RAD = 1e-12
_Three = tuple[float, float, float]
_Four = tuple[float, float, float, float]


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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
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
    c = (centre_mm[0], centre_mm[1], centre_mm[2])
    for m in range(first_s.size):
        if np.isnan(first_s[m]) or np.isnan(second_s[m]):
            for k in range(6):
                out[m, k] = np.nan
            continue
        (x, y, z, w), before = _pose_at(readings, first_s[m])
        second, after = _pose_at(readings, second_s[m])
        back = (-x, -y, -z, w)
        # R1' (p2 + R2 c - p1) - c
        at = _turned(second, c)
        at = _turned(
            back,
            (at[0] + after[0] - before[0], at[1] + after[1] - before[1], at[2] + after[2] - before[2]),
        )
        turn = _product(back, second)
        norm = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
        angle = 2.0 * np.arctan2(norm, abs(turn[3]))
        size = np.rad2deg(angle / norm if norm > _STILL_RAD else 2.0) * (-1.0 if turn[3] < 0.0 else 1.0)
        for k in range(3):
            out[m, k] = at[k] - c[k]
            out[m, 3 + k] = size * turn[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _pose_at(readings: Readings, time_s: float) -> tuple[_Four, _Three]:
    """Rotation and place of the image at a time."""
    time, turned, moved = readings.time_s, readings.turned, readings.moved
    # NumPy's search is as quick, but takes half a second to compile.
    low, high = 0, time.size
    while low < high:
        middle = (low + high) // 2
        if time[middle] < time_s:
            low = middle + 1
        else:
            high = middle
    k = max(min(low, time.size - 1), 1) - 1
    n = min(k + 1, time.size - 1)
    part = (time_s - time[k]) / (time[n] - time[k]) if n > k else 0.0
    alike, across, along = 0.0, 0.0, 0.0
    for j in range(4):
        alike += turned[k, j] * turned[n, j]
    side = -1.0 if alike < 0.0 else 1.0
    for j in range(4):
        across += (side * turned[n, j] - turned[k, j]) ** 2
        along += (side * turned[n, j] + turned[k, j]) ** 2
    angle = 2.0 * np.arctan2(np.sqrt(across), np.sqrt(along))
    a, b = 1.0 - part, side * part
    if angle > _STILL_RAD:
        a, b = np.sin(a * angle) / np.sin(angle), side * np.sin(part * angle) / np.sin(angle)
    sensor = (
        a * turned[k, 0] + b * turned[n, 0],
        a * turned[k, 1] + b * turned[n, 1],
        a * turned[k, 2] + b * turned[n, 2],
        a * turned[k, 3] + b * turned[n, 3],
    )
    q, t = readings.mounting_turned, readings.mounting_moved
    x, y, z = _turned(sensor, (t[0], t[1], t[2]))
    place = (
        x + moved[k, 0] + part * (moved[n, 0] - moved[k, 0]),
        y + moved[k, 1] + part * (moved[n, 1] - moved[k, 1]),
        z + moved[k, 2] + part * (moved[n, 2] - moved[k, 2]),
    )
    return _product(sensor, (q[0], q[1], q[2], q[3])), place


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _product(a: _Four, b: _Four) -> _Four:
    """Of two quaternions."""
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def _turned(q: _Four, v: _Three) -> _Three:
    """A vector turned by a unit quaternion."""
    x = 2.0 * (q[1] * v[2] - q[2] * v[1])
    y = 2.0 * (q[2] * v[0] - q[0] * v[2])
    z = 2.0 * (q[0] * v[1] - q[1] * v[0])
    return (
        v[0] + q[3] * x + q[1] * z - q[2] * y,
        v[1] + q[3] * y + q[2] * x - q[0] * z,
        v[2] + q[3] * z + q[0] * y - q[1] * x,
    )
