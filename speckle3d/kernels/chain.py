"""The chain of a calibration with a phantom, from pixels to what must vanish in the target's frame."""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray

PARAMETERS = 14
"""Pixel sizes; shifts and fixed angles (about z, y, x) of the image; the same of the target."""

_SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}


@njit(cache=True, nogil=True, error_model="numpy", fastmath=False)
def turned(angles: FloatArray, rotation: FloatArray, derivatives: FloatArray) -> None:
    """Fill the rotation by fixed angles, Rz(a) Ry(b) Rx(c), and its derivatives by each, shape (3, 3, 3)."""
    ca, sa = math.cos(angles[0]), math.sin(angles[0])
    cb, sb = math.cos(angles[1]), math.sin(angles[1])
    cc, sc = math.cos(angles[2]), math.sin(angles[2])
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = -sb, cb * sc, cb * cc
    for j in range(3):
        derivatives[0, 0, j], derivatives[0, 1, j] = -rotation[1, j], rotation[0, j]
        derivatives[0, 2, j] = 0.0
        derivatives[1, 0, j] = ca * rotation[2, j]
        derivatives[1, 1, j] = sa * rotation[2, j]
        derivatives[1, 2, j] = -ca * rotation[0, j] - sa * rotation[1, j]
        derivatives[2, j, 0] = 0.0
        derivatives[2, j, 1] = rotation[j, 2]
        derivatives[2, j, 2] = -rotation[j, 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def chain_residuals(
    pixel_mm: FloatArray,
    probe: FloatArray,
    target: FloatArray,
    pixels: FloatArray,
    turns: FloatArray,
    shifts: FloatArray,
    rows: FloatArray,
    offsets: FloatArray,
    values: FloatArray,
) -> None:
    """Fill what does not vanish in the target's frame.

    Parameters
    ----------
    pixel_mm : ndarray, shape (2,)
    probe, target : ndarray, shape (4, 4)
        ``sensor_from_image`` and ``target_from_world``.
    pixels : ndarray, shape (n, 2)
    turns, shifts : ndarray, shapes (n, 3, 3) and (n, 3)
        ``world_from_sensor``.
    rows, offsets : ndarray, shapes (n, r, 3) and (n, r)
        ``rows @ position - offsets`` in the target's frame must vanish.
    values : ndarray, shape (n, r)
        Filled.
    """
    for k in range(pixels.shape[0]):
        x, y = pixels[k, 0] * pixel_mm[0], pixels[k, 1] * pixel_mm[1]
        a = probe[0, 0] * x + probe[0, 1] * y + probe[0, 3]
        b = probe[1, 0] * x + probe[1, 1] * y + probe[1, 3]
        c = probe[2, 0] * x + probe[2, 1] * y + probe[2, 3]
        turn = turns[k]
        wx = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c + shifts[k, 0]
        wy = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c + shifts[k, 1]
        wz = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c + shifts[k, 2]
        px = target[0, 0] * wx + target[0, 1] * wy + target[0, 2] * wz + target[0, 3]
        py = target[1, 0] * wx + target[1, 1] * wy + target[1, 2] * wz + target[1, 3]
        pz = target[2, 0] * wx + target[2, 1] * wy + target[2, 2] * wz + target[2, 3]
        for r in range(rows.shape[1]):
            row = rows[k, r]
            values[k, r] = row[0] * px + row[1] * py + row[2] * pz - offsets[k, r]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def chain_derivatives(
    parameters: FloatArray,
    pixels: FloatArray,
    turns: FloatArray,
    shifts: FloatArray,
    rows: FloatArray,
    offsets: FloatArray,
    columns: IntArray,
    weights: FloatArray,
    values: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Fill weighted residuals and their derivatives by some of the fourteen parameters.

    Parameters
    ----------
    parameters : ndarray, shape (14,)
        Pixel sizes; shift and fixed angles of the image in the sensor's frame; the same of the world in the
        target's.
    pixels, turns, shifts, rows, offsets
        See `chain_residuals`.
    columns : ndarray of int, shape (p,)
        The parameters by number.
    weights : ndarray, shape (n, r)
    values : ndarray, shape (n r,)
        Filled.
    jacobian : ndarray, shape (n r, p)
        Filled.
    """
    probe, by_probe = np.empty((3, 3)), np.empty((3, 3, 3))
    target, by_target = np.empty((3, 3)), np.empty((3, 3, 3))
    turned(parameters[5:8], probe, by_probe)
    turned(parameters[11:14], target, by_target)
    slope = np.empty(PARAMETERS)
    at = 0
    for k in range(pixels.shape[0]):
        x, y = pixels[k, 0] * parameters[0], pixels[k, 1] * parameters[1]
        a = probe[0, 0] * x + probe[0, 1] * y + parameters[2]
        b = probe[1, 0] * x + probe[1, 1] * y + parameters[3]
        c = probe[2, 0] * x + probe[2, 1] * y + parameters[4]
        turn = turns[k]
        wx = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c + shifts[k, 0]
        wy = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c + shifts[k, 1]
        wz = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c + shifts[k, 2]
        px = target[0, 0] * wx + target[0, 1] * wy + target[0, 2] * wz + parameters[8]
        py = target[1, 0] * wx + target[1, 1] * wy + target[1, 2] * wz + parameters[9]
        pz = target[2, 0] * wx + target[2, 1] * wy + target[2, 2] * wz + parameters[10]
        for r in range(rows.shape[1]):
            rx, ry, rz = rows[k, r, 0], rows[k, r, 1], rows[k, r, 2]
            # The row in the world's axes, then in the sensor's.
            ux = rx * target[0, 0] + ry * target[1, 0] + rz * target[2, 0]
            uy = rx * target[0, 1] + ry * target[1, 1] + rz * target[2, 1]
            uz = rx * target[0, 2] + ry * target[1, 2] + rz * target[2, 2]
            sx = ux * turn[0, 0] + uy * turn[1, 0] + uz * turn[2, 0]
            sy = ux * turn[0, 1] + uy * turn[1, 1] + uz * turn[2, 1]
            sz = ux * turn[0, 2] + uy * turn[1, 2] + uz * turn[2, 2]
            slope[0] = (sx * probe[0, 0] + sy * probe[1, 0] + sz * probe[2, 0]) * pixels[k, 0]
            slope[1] = (sx * probe[0, 1] + sy * probe[1, 1] + sz * probe[2, 1]) * pixels[k, 1]
            slope[2], slope[3], slope[4] = sx, sy, sz
            slope[8], slope[9], slope[10] = rx, ry, rz
            for angle in range(3):
                d = by_probe[angle]
                slope[5 + angle] = (
                    sx * (d[0, 0] * x + d[0, 1] * y)
                    + sy * (d[1, 0] * x + d[1, 1] * y)
                    + sz * (d[2, 0] * x + d[2, 1] * y)
                )
                d = by_target[angle]
                slope[11 + angle] = (
                    rx * (d[0, 0] * wx + d[0, 1] * wy + d[0, 2] * wz)
                    + ry * (d[1, 0] * wx + d[1, 1] * wy + d[1, 2] * wz)
                    + rz * (d[2, 0] * wx + d[2, 1] * wy + d[2, 2] * wz)
                )
            weight = weights[k, r]
            values[at] = weight * (rx * px + ry * py + rz * pz - offsets[k, r])
            for i in range(columns.shape[0]):
                jacobian[at, i] = weight * slope[columns[i]]
            at += 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_SUMS_IN_ANY_ORDER)
def placed_between(
    probe: FloatArray,
    target: FloatArray,
    turns: FloatArray,
    shifts: FloatArray,
    placed_turns: FloatArray,
    placed_shifts: FloatArray,
) -> None:
    """Fill ``target * pose * probe``: matrices of shape (4, 4), turns (n, 3, 3) and shifts (n, 3)."""
    half = np.empty((3, 3))
    for k in range(turns.shape[0]):
        for i in range(3):
            shift = target[i, 3]
            for j in range(3):
                half[i, j] = (
                    target[i, 0] * turns[k, 0, j]
                    + target[i, 1] * turns[k, 1, j]
                    + target[i, 2] * turns[k, 2, j]
                )
                shift += target[i, j] * shifts[k, j]
            for j in range(3):
                shift += half[i, j] * probe[j, 3]
                placed_turns[k, i, j] = (
                    half[i, 0] * probe[0, j] + half[i, 1] * probe[1, j] + half[i, 2] * probe[2, j]
                )
            placed_shifts[k, i] = shift
