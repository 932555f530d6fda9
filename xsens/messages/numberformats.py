"""The four ways in which the sensors write a real number, all big-endian.

float32; FP12.20, a 32-bit integer over 2**20; FP16.32, a 48-bit integer over 2**32, its 32 bits of fraction
before its 16 bits of integer; float64. Every value of each is exact as float64.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray, FloatArray
from speckle3d.core.errors import InvalidInputError


class NumberFormat(IntEnum):
    """How real numbers are written; the values are those of the vendor's two-bit fields."""

    FLOAT32 = 0
    FP12_20 = 1
    FP16_32 = 2
    FLOAT64 = 3

    @property
    def size(self) -> int:
        """Bytes of one number."""
        return (4, 4, 6, 8)[self]


def numbers_from_bytes(rows: ByteArray, form: NumberFormat) -> FloatArray:
    """Decode rows of bytes, shape (n, k * size), as float64, shape (n, k)."""
    packed = np.ascontiguousarray(rows)
    if form in (NumberFormat.FLOAT32, NumberFormat.FLOAT64):
        with np.errstate(invalid="ignore"):  # signalling NaNs, which damage can make
            return packed.view(f">f{form.size}").astype(np.float64)
    if form is NumberFormat.FP12_20:
        return packed.view(">i4") / 2.0**20
    parts = packed.reshape(len(rows), -1, 6)
    fraction = np.ascontiguousarray(parts[..., :4]).view(">u4")[..., 0]
    whole = np.ascontiguousarray(parts[..., 4:]).view(">i2")[..., 0]
    return np.asarray(whole + fraction / 2.0**32)


def bytes_from_numbers(values: npt.ArrayLike, form: NumberFormat) -> ByteArray:
    """Encode numbers, shape (n, k), to the nearest that `form` can hold, as rows of bytes.

    Raises
    ------
    InvalidInputError
        If a number is beyond the range of a fixed-point format, or not finite there.
    """
    array = np.asarray(values, dtype=np.float64)
    if form in (NumberFormat.FLOAT32, NumberFormat.FLOAT64):
        with np.errstate(over="ignore", invalid="ignore"):  # to infinity, as the sensor's own would
            packed = np.ascontiguousarray(array.astype(f">f{form.size}"))
        return packed.view(np.uint8)
    if form is NumberFormat.FP12_20:
        return np.ascontiguousarray(_scaled(array, 20, 31).astype(">i4")).view(np.uint8)
    ticks = np.ascontiguousarray(_scaled(array, 32, 47).astype(">i8")[..., None]).view(np.uint8)
    parts = np.concatenate((ticks[..., 4:], ticks[..., 2:4]), axis=-1)
    return parts.reshape(*array.shape[:-1], -1)


def _scaled(array: FloatArray, fraction_bits: int, whole_bits: int) -> FloatArray:
    """Whole multiples of the last bit, checked against the range."""
    scaled = np.round(array * 2.0**fraction_bits)
    limit = 2.0**whole_bits
    bad = ~((scaled >= -limit) & (scaled < limit))
    if bad.any():
        raise InvalidInputError(
            f"expected numbers within ±{limit / 2.0**fraction_bits:g} for a fixed-point format, "
            f"got {array[bad].flat[0]:g}"
        )
    return np.asarray(scaled)
