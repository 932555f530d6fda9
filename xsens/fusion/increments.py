"""Gyroscope and accelerometer samples summed to short increments, so that the filter need not run at each.

Within a block the sum is exact for whatever the sensor does: turns are multiplied, specific force is
turned into the block's first frame before it is added. What the filter does per block then costs little
per sample.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from xsens.fusion import quaternions


@dataclass(frozen=True)
class Increment:
    """What the sensor did in one block, seen from the sensor as it was when the block began.

    Attributes
    ----------
    duration_s : float
    turn : ndarray, shape (3, 3)
        ``start_from_end``, by the gyroscope less `bias_rad_s`.
    bias_rad_s : ndarray, shape (3,)
        The gyroscope's bias that was assumed.
    velocity_m_s : ndarray, shape (3,)
        Specific force integrated, gravity included.
    rate_rad_s : ndarray, shape (3,)
        Mean of what the gyroscope read, bias included.
    field_au : ndarray, shape (3,), or None
        Mean magnetic field, None if no sample had one.
    """

    duration_s: float
    turn: FloatArray
    bias_rad_s: FloatArray
    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    field_au: FloatArray | None


@dataclass(frozen=True)
class Samples:
    """Samples of one stretch without a pause; the first starts the stretch and is one step after nothing.

    Attributes
    ----------
    step_s : ndarray, shape (m,)
        Time from the sample before to each sample.
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
    """Increments of consecutive blocks of as many samples each.

    Attributes
    ----------
    turns_wxyz : ndarray, shape (blocks, samples, 4)
        ``start_from_sample`` of every sample of every block.
    step_s : ndarray, shape (blocks, samples)
    velocity_m_s, rate_rad_s, field_au : ndarray, shape (blocks, 3)
        As in `Increment`; NaN rows of `field_au` where it is None there.
    bias_rad_s : ndarray, shape (3,)
    """

    turns_wxyz: FloatArray
    step_s: FloatArray
    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    field_au: FloatArray
    bias_rad_s: FloatArray

    def __iter__(self) -> Iterator[Increment]:
        last = quaternions.matrices(self.turns_wxyz[:, -1])
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
    turns = _running_product(quaternions.from_vectors(angle))
    halfway = quaternions.product(turns, quaternions.from_vectors(-0.5 * angle))
    force = quaternions.rotated(halfway, samples.force_m_s2.reshape(*shape, 3))
    field = quaternions.rotated(turns, samples.field_au.reshape(*shape, 3))
    return Blocks(
        turns,
        step,
        (force * step[..., None]).sum(axis=1),
        (rate * step[..., None]).sum(axis=1) / step.sum(axis=1)[:, None],
        _mean_of_finite(field),
        bias_rad_s,
    )


def _running_product(turns: FloatArray) -> FloatArray:
    """Product of the turns of each block up to and with each sample, shape (blocks, samples, 4)."""
    products = turns.copy()
    for k in range(1, turns.shape[1]):
        products[:, k] = quaternions.product(products[:, k - 1], turns[:, k])
    return products


def _mean_of_finite(vectors: FloatArray) -> FloatArray:
    """Mean over the second axis of (blocks, samples, 3), leaving NaN samples out; NaN if none is left."""
    finite = np.asarray(np.isfinite(vectors).all(axis=2))
    count = finite.sum(axis=1)
    total = np.where(finite[..., None], vectors, 0.0).sum(axis=1)
    return np.asarray(np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], np.nan))
