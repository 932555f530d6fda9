"""Sum gyroscope and accelerometer samples to short increments, on which the filter runs.

Within a block the sums are exact for any movement: turns are multiplied, specific force is turned into the
block's first frame before it is added. The filter then runs once a block instead of once a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

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
    turns_xyzw : ndarray, shape (samples, 4)
        ``start_from_sample`` of every sample, scalar last.
    time_s : ndarray, shape (samples,)
        Time of every sample since the start.
    """

    duration_s: float
    turn: FloatArray
    bias_rad_s: FloatArray
    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    field_au: FloatArray | None
    turns_xyzw: FloatArray
    time_s: FloatArray


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


def increments_of(samples: Samples, per_block: int, bias_rad_s: FloatArray) -> list[Increment]:
    """Sum `samples`, a whole number of blocks, with a gyroscope bias of `bias_rad_s`, shape (3,)."""
    blocks = len(samples) // per_block

    def by_place(values: FloatArray) -> FloatArray:
        """Values in the order of their place in the block, so that one product serves all blocks."""
        return values.reshape(blocks, per_block, -1).swapaxes(0, 1)

    step, rate, force = (by_place(a) for a in (samples.step_s, samples.rate_rad_s, samples.force_m_s2))
    angle = (rate - bias_rad_s) * step
    products = [Rotation.from_rotvec(angle[0])]
    for each in angle[1:]:
        products.append(products[-1] * Rotation.from_rotvec(each))
    turns = Rotation.concatenate(products)
    halfway = turns * Rotation.from_rotvec(-0.5 * angle.reshape(-1, 3))
    velocity = (halfway.apply(force.reshape(-1, 3)).reshape(force.shape) * step).sum(axis=0)
    field = turns.apply(by_place(samples.field_au).reshape(-1, 3)).reshape(force.shape)
    duration = step.sum(axis=0)
    mean_rate, mean_field = (rate * step).sum(axis=0) / duration, _mean_of_finite(field)
    quaternions = turns.as_quat().reshape(per_block, blocks, 4)
    time_s, ends = np.cumsum(step[..., 0], axis=0), products[-1].as_matrix()
    return [
        Increment(
            float(duration[k, 0]),
            ends[k],
            bias_rad_s,
            velocity[k],
            mean_rate[k],
            mean_field[k] if np.isfinite(mean_field[k]).all() else None,
            quaternions[:, k],
            time_s[:, k],
        )
        for k in range(blocks)
    ]


def _mean_of_finite(vectors: FloatArray) -> FloatArray:
    """Mean over the first axis of (samples, blocks, 3), leaving NaN samples out; NaN if none is left."""
    finite = np.isfinite(vectors).all(axis=2, keepdims=True)
    count = finite.sum(axis=0)
    total = np.where(finite, vectors, 0.0).sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


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
