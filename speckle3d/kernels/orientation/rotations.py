"""Rotations and small systems for kernels: matrices by rows, shape (9,), quaternions scalar last."""

import math

from numba import njit

from speckle3d.core.arrays import FloatArray


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def turn_into(x: float, y: float, z: float, out: FloatArray) -> None:
    """Fill the matrix of a rotation vector, rad."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    s, c = 1.0, 0.5
    if angle > 1e-6:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    out[0], out[1], out[2] = 1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    out[3], out[4], out[5] = c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x
    out[6], out[7], out[8] = c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def product_into(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Fill ``a @ b``, which may be either of them."""
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7], b[8]
    for i in range(0, 9, 3):
        x, y, z = a[i], a[i + 1], a[i + 2]
        out[i] = x * b0 + y * b3 + z * b6
        out[i + 1] = x * b1 + y * b4 + z * b7
        out[i + 2] = x * b2 + y * b5 + z * b8


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def back_product_into(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Fill ``a @ b.T``, which may be either of them."""
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7], b[8]
    for i in range(0, 9, 3):
        x, y, z = a[i], a[i + 1], a[i + 2]
        out[i] = x * b0 + y * b1 + z * b2
        out[i + 1] = x * b3 + y * b4 + z * b5
        out[i + 2] = x * b6 + y * b7 + z * b8


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def apply_into(a: FloatArray, v: FloatArray, out: FloatArray) -> None:
    """Fill ``a @ v``; `v` and `out`, shape (3,), may be the same."""
    x, y, z = v[0], v[1], v[2]
    for i in range(3):
        out[i] = a[3 * i] * x + a[3 * i + 1] * y + a[3 * i + 2] * z


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def quaternion_of(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Quaternion of a rotation vector, rad."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    s = math.sin(0.5 * angle) / angle if angle > 1e-3 else 0.5 - square / 48.0 + square * square / 3840.0
    return s * x, s * y, s * z, math.cos(0.5 * angle)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
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


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def matrix_into(q: tuple[float, ...], out: FloatArray) -> None:
    """Fill the matrix of a unit quaternion."""
    x, y, z, w = q
    out[0], out[1], out[2] = w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[3], out[4], out[5] = 2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)
    out[6], out[7], out[8] = 2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def quaternion_from(m: FloatArray) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation matrix (Shepperd's method)."""
    trace = m[0] + m[4] + m[8]
    most = max(trace, m[0], m[4], m[8])
    if most == trace:
        x, y, z, w = m[7] - m[5], m[2] - m[6], m[3] - m[1], 1.0 + trace
    elif most == m[0]:
        x, y, z, w = 1.0 - trace + 2.0 * m[0], m[3] + m[1], m[6] + m[2], m[7] - m[5]
    elif most == m[4]:
        x, y, z, w = m[3] + m[1], 1.0 - trace + 2.0 * m[4], m[7] + m[5], m[2] - m[6]
    else:
        x, y, z, w = m[6] + m[2], m[7] + m[5], 1.0 - trace + 2.0 * m[8], m[3] - m[1]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return x / norm, y / norm, z / norm, w / norm


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def vector_of(q: tuple[float, ...]) -> tuple[float, float, float]:
    """Rotation vector, rad, of a unit quaternion; the shorter one."""
    x, y, z, w = q
    sine = math.sqrt(x * x + y * y + z * z)
    angle = 2.0 * math.atan2(sine, abs(w))
    s = angle / sine if sine > 1e-8 else 2.0
    s = -s if w < 0.0 else s
    return s * x, s * y, s * z


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def sparse_product_into(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Fill ``a @ b``, shape (n, k), which is neither of them; fast where `a` is mostly zeros."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = 0.0
        for m in range(a.shape[1]):
            factor = a[i, m]
            if factor != 0.0:
                for j in range(out.shape[1]):
                    out[i, j] += factor * b[m, j]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def solve_into(matrix: FloatArray, right: FloatArray) -> None:
    """Solve ``matrix @ x = right`` by elimination with pivots; `right` becomes x.

    `right`, shape (n, k), tells the size; of `matrix`, which is destroyed, n rows and columns count.
    """
    n, across = right.shape
    for i in range(n):
        pivot = i
        for j in range(i + 1, n):
            if abs(matrix[j, i]) > abs(matrix[pivot, i]):
                pivot = j
        if pivot != i:
            for k in range(n):
                matrix[i, k], matrix[pivot, k] = matrix[pivot, k], matrix[i, k]
            for k in range(across):
                right[i, k], right[pivot, k] = right[pivot, k], right[i, k]
        for j in range(i + 1, n):
            factor = matrix[j, i] / matrix[i, i]
            if factor != 0.0:
                for k in range(i + 1, n):
                    matrix[j, k] -= factor * matrix[i, k]
                for k in range(across):
                    right[j, k] -= factor * right[i, k]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = matrix[i, j]
            for k in range(across):
                right[i, k] -= factor * right[j, k]
        for k in range(across):
            right[i, k] /= matrix[i, i]
