"""Rotations and small matrices for kernels: matrices of shape (3, 3), quaternions with the scalar last."""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def turn_into(x: float, y: float, z: float, out: FloatArray) -> None:
    """Fill the matrix of a rotation vector, rad."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-6:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    else:
        s, c = 1.0, 0.5
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)


@njit(cache=True, nogil=True, error_model="numpy")
def product_into(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Fill ``a @ b``, which may be either of them."""
    held = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            held[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    out[:] = held


@njit(cache=True, nogil=True, error_model="numpy")
def apply_into(a: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """Fill ``a @ v``; `v` and `out` may be the same."""
    x, y, z = v[0], v[1], v[2]
    for i in range(3):
        out[i] = a[i, 0] * x + a[i, 1] * y + a[i, 2] * z


@njit(cache=True, nogil=True, error_model="numpy")
def quaternion_of(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Quaternion of a rotation vector, rad."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    s = math.sin(0.5 * angle) / angle if angle > 1e-3 else 0.5 - square / 48.0 + square * square / 3840.0
    return s * x, s * y, s * z, math.cos(0.5 * angle)


@njit(cache=True, nogil=True, error_model="numpy")
def multiplied(p: tuple[float, ...], q: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Quaternion of the rotation by `q`, then by `p`."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def matrix_into(q: tuple[float, ...], out: FloatArray) -> None:
    """Fill the matrix of a unit quaternion."""
    x, y, z, w = q
    out[0, 0], out[0, 1], out[0, 2] = w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z


@njit(cache=True, nogil=True, error_model="numpy")
def quaternion_from(m: FloatArray) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation matrix (Shepperd's method)."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    k = 3
    most = trace
    for i in range(3):
        if m[i, i] > most:
            k, most = i, m[i, i]
    q = np.empty(4)
    if k == 3:
        q[0], q[1], q[2] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
        q[3] = 1.0 + trace
    else:
        i, j, l = k, (k + 1) % 3, (k + 2) % 3  # noqa: E741
        q[i] = 1.0 - trace + 2.0 * m[i, i]
        q[j] = m[j, i] + m[i, j]
        q[l] = m[l, i] + m[i, l]
        q[3] = m[l, j] - m[j, l]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


@njit(cache=True, nogil=True, error_model="numpy")
def vector_of(q: tuple[float, ...]) -> tuple[float, float, float]:
    """Rotation vector, rad, of a unit quaternion; the shorter one."""
    x, y, z, w = q
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2.0 * math.atan2(sine, w)
    s = angle / sine if sine > 1e-8 else 2.0
    return s * x, s * y, s * z


@njit(cache=True, nogil=True, error_model="numpy")
def solve_into(matrix: FloatArray, right: FloatArray) -> None:
    """Solve ``matrix @ x = right`` by elimination with pivots; `right`, shape (n, k), becomes x.

    `matrix`, of which the first n rows and columns count, is destroyed.
    """
    n = right.shape[0]
    for i in range(n):
        pivot = i
        for j in range(i + 1, n):
            if abs(matrix[j, i]) > abs(matrix[pivot, i]):
                pivot = j
        if pivot != i:
            for k in range(n):
                matrix[i, k], matrix[pivot, k] = matrix[pivot, k], matrix[i, k]
            for k in range(right.shape[1]):
                right[i, k], right[pivot, k] = right[pivot, k], right[i, k]
        for j in range(i + 1, n):
            factor = matrix[j, i] / matrix[i, i]
            if factor != 0.0:
                for k in range(i + 1, n):
                    matrix[j, k] -= factor * matrix[i, k]
                for k in range(right.shape[1]):
                    right[j, k] -= factor * right[i, k]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = matrix[i, j]
            for k in range(right.shape[1]):
                right[i, k] -= factor * right[j, k]
        for k in range(right.shape[1]):
            right[i, k] /= matrix[i, i]
