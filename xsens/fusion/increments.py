"""Sum gyroscope and accelerometer samples to short increments, on which the filter runs.

Within a block the sums are exact for any movement: turns are multiplied, specific force is turned into the
block's first frame before it is added. The filter then runs once a block instead of once a sample.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray


@dataclass(frozen=True)
class Increment:
    """Motion of the sensor in one block, in the sensor's axes at the start of the block.

    Attributes
    ----------
    duration_s : float
    turn : ndarray, shape (3, 3)
        ``start_from_end``, by the gyroscope less `bias_rad_s`.
    bias_rad_s : ndarray, shape (3,)
        The assumed gyroscope bias.
    velocity_m_s : ndarray, shape (3,)
        Integral of the specific force, gravity included.
    rate_rad_s : ndarray, shape (3,)
        Mean reading of the gyroscope, bias included.
    field_au : ndarray, shape (3,), or None
        Mean magnetic field; None if no sample had one.
    """

    duration_s: float
    turn: FloatArray
    bias_rad_s: FloatArray
    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    field_au: FloatArray | None


@dataclass(frozen=True)
class Samples:
    """Samples of one stretch without a pause.

    Attributes
    ----------
    step_s : ndarray, shape (m,)
        Time from the sample before to each sample; the first is a usual step.
    rate_rad_s, force_m_s2 : ndarray, shape (m, 3)
        Gyroscope and accelerometer, finite.
    field_au : ndarray, shape (m, 3)
        Magnetometer; rows may be NaN.
    """

    step_s: FloatArray
    rate_rad_s: FloatArray
    force_m_s2: FloatArray
    field_au: FloatArray

    def __len__(self) -> int:
        return int(self.step_s.size)

    def __getitem__(self, part: slice) -> Samples:
        return Samples(self.step_s[part], self.rate_rad_s[part], self.force_m_s2[part], self.field_au[part])


@dataclass(frozen=True)
class Blocks:
    """Increments of consecutive blocks, all of the same number of samples.

    Attributes
    ----------
    turns_wxyz : ndarray, shape (blocks, samples, 4)
        ``start_from_sample`` of every sample of every block.
    step_s : ndarray, shape (blocks, samples)
    velocity_m_s, rate_rad_s, field_au : ndarray, shape (blocks, 3)
        As in `Increment`; a row of `field_au` is NaN where an increment's is None.
    bias_rad_s : ndarray, shape (3,)
    """

    turns_wxyz: FloatArray
    step_s: FloatArray
    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    field_au: FloatArray
    bias_rad_s: FloatArray

    def __iter__(self) -> Iterator[Increment]:
        last = rotation_matrices(self.turns_wxyz[:, -1])
        durations = self.step_s.sum(axis=1)
        has_field = np.asarray(np.isfinite(self.field_au).all(axis=1))
        for k, duration in enumerate(durations):
            field = self.field_au[k] if has_field[k] else None
            yield Increment(
                float(duration), last[k], self.bias_rad_s, self.velocity_m_s[k], self.rate_rad_s[k], field
            )


def blocks_of(samples: Samples, per_block: int, bias_rad_s: FloatArray) -> Blocks:
    """Sum `samples`, a whole number of blocks, with a gyroscope bias of `bias_rad_s`, shape (3,)."""
    shape = (len(samples) // per_block, per_block)
    step = samples.step_s.reshape(shape)
    rate = samples.rate_rad_s.reshape(*shape, 3)
    angle = (rate - bias_rad_s) * step[..., None]
    turns = _running_product(quaternions_of(angle))
    halfway = quaternion_product(turns, quaternions_of(-0.5 * angle))
    force = rotated(halfway, samples.force_m_s2.reshape(*shape, 3))
    field = rotated(turns, samples.field_au.reshape(*shape, 3))
    return Blocks(
        turns,
        step,
        (force * step[..., None]).sum(axis=1),
        (rate * step[..., None]).sum(axis=1) / step.sum(axis=1)[:, None],
        _mean_of_finite(field),
        bias_rad_s,
    )


def _running_product(turns: FloatArray) -> FloatArray:
    """Product of the turns of each block up to and including each sample, shape (blocks, samples, 4)."""
    products = turns.copy()
    for k in range(1, turns.shape[1]):
        products[:, k] = quaternion_product(products[:, k - 1], turns[:, k])
    return products


def _mean_of_finite(vectors: FloatArray) -> FloatArray:
    """Mean over the second axis of (blocks, samples, 3), leaving NaN samples out; NaN if none is left."""
    finite = np.asarray(np.isfinite(vectors).all(axis=2))
    count = finite.sum(axis=1)
    total = np.where(finite[..., None], vectors, 0.0).sum(axis=1)
    return np.asarray(np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], np.nan))


# -- unit quaternions, scalar first, on arrays of any leading shape
#
# SciPy's Rotation is the public type; here an object per block would take longer than the sums.


def quaternions_of(vectors_rad: FloatArray) -> FloatArray:
    """Quaternions, shape (..., 4), of rotation vectors, shape (..., 3)."""
    half = 0.5 * np.linalg.norm(vectors_rad, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vectors_rad], axis=-1)


def quaternion_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Hamilton product ``a b`` of quaternions, shape (..., 4)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = aw * bw - (av * bv).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + np.cross(av, bv)], axis=-1)


def rotated(quaternions: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors, shape (..., 3), turned by quaternions, shape (..., 4)."""
    axis = quaternions[..., 1:]
    across = 2.0 * np.cross(axis, vectors)
    return np.asarray(vectors + quaternions[..., :1] * across + np.cross(axis, across))


def rotation_matrices(quaternions: FloatArray) -> FloatArray:
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
