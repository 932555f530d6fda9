"""Unit quaternions, scalar last, as tuples, and a small inverse, for kernels."""

import math
from typing import Any, TypeAlias

import numpy as np
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.elimination import invert_matrix

compiled = njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
for_kernels = register_jitable(fastmath=False, error_model="numpy")

Quaternion: TypeAlias = tuple[float, float, float, float]
Vector: TypeAlias = tuple[float, float, float]

AXES = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@for_kernels
def three(v: FloatArray) -> Vector:
    """The vector in an array."""
    return v[0], v[1], v[2]


@for_kernels
def difference(v: Any, w: Any) -> Vector:
    """The vector `v` less `w`, arrays or tuples."""
    return v[0] - w[0], v[1] - w[1], v[2] - w[2]


@for_kernels
def norm(v: Any) -> float:
    """Length of the vector in an array or a tuple."""
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@for_kernels
def store(values: Any, out: FloatArray) -> None:
    """Copy numbers, an array or a tuple, to an array.

    ``out[:] = values`` does the same, and compiles for seconds, for numba's words about its shape.
    """
    for i in range(len(values)):
        out[i] = values[i]


@for_kernels
def quaternion(q: FloatArray) -> Quaternion:
    """The quaternion in an array, of unit length."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return x / norm, y / norm, z / norm, w / norm


@for_kernels
def quaternion_of(x: float, y: float, z: float) -> Quaternion:
    """Quaternion of a rotation vector, rad."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    s = math.sin(0.5 * angle) / angle if angle > 1e-3 else 0.5 - square / 48.0 + square * square / 3840.0
    return s * x, s * y, s * z, math.cos(0.5 * angle)


@for_kernels
def turn_by(rate: FloatArray, bias: FloatArray, span_s: float) -> Quaternion:
    """Turn by a reading of the gyroscope over some time."""
    x, y, z = difference(rate, bias)
    return quaternion_of(x * span_s, y * span_s, z * span_s)


@for_kernels
def vector_of(q: Quaternion) -> Vector:
    """Rotation vector, rad, of a unit quaternion; the shorter one."""
    x, y, z, w = q
    sine = math.sqrt(x * x + y * y + z * z)
    s = 2.0 * math.atan2(sine, abs(w)) / sine if sine > 1e-8 else 2.0
    s = -s if w < 0.0 else s
    return s * x, s * y, s * z


@for_kernels
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


@for_kernels
def invert(q: Quaternion) -> Quaternion:
    """Quaternion of the rotation back."""
    return -q[0], -q[1], -q[2], q[3]


@for_kernels
def rotate(q: Quaternion, v: Vector) -> Vector:
    """A vector turned by a unit quaternion."""
    x, y, z, w = q
    a = 2.0 * (y * v[2] - z * v[1])
    b = 2.0 * (z * v[0] - x * v[2])
    c = 2.0 * (x * v[1] - y * v[0])
    return v[0] + w * a + y * c - z * b, v[1] + w * b + z * a - x * c, v[2] + w * c + x * b - y * a


@for_kernels
def times_transpose(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a @ b.T`` by loops: of small matrices, faster than a call of BLAS; zeros of `a` are skipped."""
    out = np.zeros((a.shape[0], b.shape[0]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            if a[i, k] != 0.0:
                for j in range(b.shape[0]):
                    out[i, j] += a[i, k] * b[j, k]
    return out


@for_kernels
def add_product(x: FloatArray, a: FloatArray, b: Any) -> None:
    """Add ``a @ b`` to the vector `x`."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            x[i] += a[i, k] * b[k]


@for_kernels
def squared_norm(v: FloatArray, weight: FloatArray) -> float:
    """Squared length of a vector, weighted by a matrix, ``v @ weight @ v``."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += v[i] * weight[i, j] * v[j]
    return total


@for_kernels
def subtract_product(p: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """Subtract ``a @ b.T`` from `p`."""
    for i in range(p.shape[0]):
        for j in range(p.shape[1]):
            for k in range(a.shape[1]):
                p[i, j] -= a[i, k] * b[j, k]


@for_kernels
def inverse(m: FloatArray, variance: float) -> tuple[FloatArray, float]:
    """Inverse of the covariance `m` and as much white noise, and their determinant."""
    out = m.copy()
    for i in range(m.shape[0]):
        out[i, i] += variance
    determinant = invert_matrix(out)
    return out, determinant
