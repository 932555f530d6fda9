"""Unit quaternions (scalar first) on arrays of any leading shape: what the filter's inner sums need.

SciPy's ``Rotation`` is the public type; here the overhead of an object per block would cost more than the
sum.
"""

from __future__ import annotations

import math

import numpy as np

from speckle3d.core.arrays import FloatArray

IDENTITY: FloatArray = np.array([1.0, 0.0, 0.0, 0.0])


def from_vectors(vectors_rad: FloatArray) -> FloatArray:
    """Quaternions, shape (..., 4), of rotation vectors, shape (..., 3)."""
    half = 0.5 * np.linalg.norm(vectors_rad, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vectors_rad], axis=-1)


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Hamilton product ``a b`` of quaternions, shape (..., 4)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = aw * bw - (av * bv).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + np.cross(av, bv)], axis=-1)


def rotated(quaternions: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors, shape (..., 3), turned by quaternions, shape (..., 4)."""
    axis = quaternions[..., 1:]
    across = 2.0 * np.cross(axis, vectors)
    return np.asarray(vectors + quaternions[..., :1] * across + np.cross(axis, across))


def matrices(quaternions: FloatArray) -> FloatArray:
    """Rotation matrices, shape (..., 3, 3)."""
    columns = [rotated(quaternions, np.broadcast_to(e, (*quaternions.shape[:-1], 3))) for e in np.eye(3)]
    return np.stack(columns, axis=-1)


def turn_matrix(vector_rad: FloatArray) -> FloatArray:
    """Rotation matrix of one rotation vector, shape (3,)."""
    x, y, z = vector_rad.tolist()
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-6:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    else:
        s, c = 1.0, 0.5
    return np.array(
        [
            [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
        ]
    )
