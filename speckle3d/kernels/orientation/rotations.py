"""Unit quaternions, scalar last, as tuples, and a small inverse, for kernels."""

import math
from typing import TypeAlias

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray

compiled = njit(cache=True, nogil=True, fastmath=False, error_model="numpy")

Quaternion: TypeAlias = tuple[float, float, float, float]
Vector: TypeAlias = tuple[float, float, float]


@compiled
def three(v: FloatArray) -> Vector:
    """The vector in an array."""
    return v[0], v[1], v[2]


@compiled
def norm(v: FloatArray) -> float:
    """Length of the vector in an array."""
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@compiled
def quaternion(q: FloatArray) -> Quaternion:
    """The quaternion in an array, of unit length."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return x / norm, y / norm, z / norm, w / norm


@compiled
def quaternion_of(x: float, y: float, z: float) -> Quaternion:
    """Quaternion of a rotation vector, rad."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    s = math.sin(0.5 * angle) / angle if angle > 1e-3 else 0.5 - square / 48.0 + square * square / 3840.0
    return s * x, s * y, s * z, math.cos(0.5 * angle)


@compiled
def turn_by(rate: FloatArray, bias: FloatArray, span_s: float) -> Quaternion:
    """Turn by a reading of the gyroscope over some time."""
    x, y, z = rate[0] - bias[0], rate[1] - bias[1], rate[2] - bias[2]
    return quaternion_of(x * span_s, y * span_s, z * span_s)


@compiled
def vector_of(q: Quaternion) -> Vector:
    """Rotation vector, rad, of a unit quaternion; the shorter one."""
    x, y, z, w = q
    sine = math.sqrt(x * x + y * y + z * z)
    s = 2.0 * math.atan2(sine, abs(w)) / sine if sine > 1e-8 else 2.0
    s = -s if w < 0.0 else s
    return s * x, s * y, s * z


@compiled
def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Quaternion of the rotation by `q`, then by `p`."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return (
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    )


@compiled
def invert(q: Quaternion) -> Quaternion:
    """Quaternion of the rotation back."""
    return -q[0], -q[1], -q[2], q[3]


@compiled
def rotate(q: Quaternion, v: Vector) -> Vector:
    """A vector turned by a unit quaternion."""
    x, y, z, w = q
    a = 2.0 * (y * v[2] - z * v[1])
    b = 2.0 * (z * v[0] - x * v[2])
    c = 2.0 * (x * v[1] - y * v[0])
    return v[0] + w * a + y * c - z * b, v[1] + w * b + z * a - x * c, v[2] + w * c + x * b - y * a


@compiled
def transported(f: FloatArray, p: FloatArray) -> FloatArray:
    """Covariance `p` after a transition `f`, ``f @ p @ f.T``; most entries of `f` are zero."""
    n = p.shape[0]
    half, out = np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            if f[i, j] != 0.0:
                for k in range(n):
                    half[k, i] += p[k, j] * f[i, j]
    for i in range(n):
        for j in range(n):
            if f[i, j] != 0.0:
                for k in range(n):
                    out[i, k] += f[i, j] * half[j, k]
    return out


@compiled
def matrix_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a @ b`` by loops: of small matrices, faster than a call of BLAS."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@compiled
def add_product(x: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """Add ``a @ b`` to the vector `x`."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            x[i] += a[i, k] * b[k]


@compiled
def subtract_product(p: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """Subtract ``a @ b.T`` from `p`; both have three columns."""
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            p[i, j] -= a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]


@compiled
def inverse(m: FloatArray) -> tuple[FloatArray, float]:
    """Inverse of a symmetric matrix, shape (3, 3), and its determinant."""
    out = np.empty((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for n in range(3):
            o, p = (n + 1) % 3, (n + 2) % 3
            out[i, n] = m[j, o] * m[k, p] - m[j, p] * m[k, o]
    determinant = m[0, 0] * out[0, 0] + m[0, 1] * out[0, 1] + m[0, 2] * out[0, 2]
    return out / determinant, determinant
