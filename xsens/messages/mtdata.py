"""Decode the legacy data message MTData, and the number formats it shares with MTData2.

The message does not describe its own layout: output mode and settings do, known from the configuration or
from whoever set them. A unit on a bus with a master, and the MT9-B, put the counter first instead of last.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import cached_property

import numpy as np

from speckle3d.core.arrays import ByteArray, FloatArray
from speckle3d.core.errors import InvalidInputError, MismatchError

Values = dict[str, FloatArray]
"""Field name to values, shape (n, count); whole numbers are exact."""


class NumberFormat(IntEnum):
    """Formats of real numbers, all big-endian; the values are those of the vendor's two-bit fields.

    FP12.20 is a 32-bit integer over 2**20; FP16.32 a 48-bit integer over 2**32, its 32 bits of fraction
    before its 16 bits of integer. Every value of each format is exact as float64.
    """

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


class OutputMode(IntFlag):
    """Parts that the sensor sends."""

    TEMPERATURE = 0x0001
    CALIBRATED = 0x0002
    ORIENTATION = 0x0004
    AUXILIARY = 0x0008
    POSITION = 0x0010
    VELOCITY = 0x0020
    STATUS = 0x0800
    RAW = 0x4000
    MT9 = 0x8000
    """The MT9-B's raw record, which begins with the counter."""


class OutputSettings(IntFlag):
    """Options of the parts; orientation and number format are fields of two bits, see `DataLayout`."""

    COUNTER = 0x1
    UTC = 0x2
    EULER = 0x4
    MATRIX = 0x8
    NO_ACCELEROMETER = 0x10
    NO_GYROSCOPE = 0x20
    NO_MAGNETOMETER = 0x40
    FP12_20 = 0x100
    FP16_32 = 0x200
    NO_ANALOG_1 = 0x400
    NO_ANALOG_2 = 0x800
    NED = 0x80000000


@dataclass(frozen=True)
class Field:
    """A run of values in a message: `kind` is real, or a NumPy type of big-endian whole numbers."""

    name: str
    count: int
    kind: str = "real"


_U2, _U1 = ">u2", ">u1"
_RAW = (
    Field("raw_accelerometer", 3, _U2),
    Field("raw_gyroscope", 3, _U2),
    Field("raw_magnetometer", 3, _U2),
    Field("raw_temperature", 1, _U2),
)
_COUNTER = Field("counter", 1, _U2)
_UTC = Field("utc", 12, _U1)
_ORIENTATION = (Field("quaternion_wxyz", 4), Field("euler_deg", 3), Field("matrix", 9))


@dataclass(frozen=True)
class DataLayout:
    """Order of the fields in an MTData payload.

    Attributes
    ----------
    mode, settings : int
        See `OutputMode` and `OutputSettings`.
    counter_first : bool
        True for a unit behind a master; mode `OutputMode.MT9` always begins with the counter.

    Raises
    ------
    InvalidInputError
        If the mode has no part, or raw counts together with another part.
    """

    mode: int
    settings: int = OutputSettings.COUNTER
    counter_first: bool = False

    def __post_init__(self) -> None:
        raw = self.mode & (OutputMode.RAW | OutputMode.MT9)
        known = sum(OutputMode)
        if self.mode & known == 0 or self.mode & ~known or (raw and self.mode not in tuple(OutputMode)):
            raise InvalidInputError(
                f"output mode: expected raw counts alone or any of the others, got {self.mode:#06x}"
            )
        if (self.settings >> 2) & 3 == 3:
            raise InvalidInputError(
                f"output settings: expected orientation as 0, 1 or 2, got 3 in {self.settings:#x}"
            )
        if not self.fields:
            raise InvalidInputError(f"output settings: expected some output, got {self.settings:#x}")

    @property
    def number_format(self) -> NumberFormat:
        """Format of real numbers."""
        return NumberFormat((self.settings >> 8) & 3)

    @property
    def frame(self) -> str:
        """World of the orientation: NED if that is set, else NWU."""
        return "NED" if self.settings & OutputSettings.NED else "NWU"

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """Fields in the order of the message."""
        if self.mode == OutputMode.MT9:
            return (_COUNTER, *_RAW)
        counter = (_COUNTER,) if self.settings & OutputSettings.COUNTER else ()
        utc = (_UTC,) if self.settings & OutputSettings.UTC else ()
        body = _RAW if self.mode == OutputMode.RAW else tuple(self._measured())
        return (*counter, *body, *utc) if self.counter_first else (*body, *counter, *utc)

    def _measured(self) -> list[Field]:
        calibrated, analog = OutputMode.CALIBRATED, OutputMode.AUXILIARY
        parts = (
            (OutputMode.TEMPERATURE, 0, Field("temperature_c", 1)),
            (calibrated, OutputSettings.NO_ACCELEROMETER, Field("accelerometer_m_s2", 3)),
            (calibrated, OutputSettings.NO_GYROSCOPE, Field("gyroscope_rad_s", 3)),
            (calibrated, OutputSettings.NO_MAGNETOMETER, Field("magnetometer_au", 3)),
            (OutputMode.ORIENTATION, 0, _ORIENTATION[(self.settings >> 2) & 3]),
            (analog, OutputSettings.NO_ANALOG_1, Field("analog_1", 1, _U2)),
            (analog, OutputSettings.NO_ANALOG_2, Field("analog_2", 1, _U2)),
            (OutputMode.POSITION, 0, Field("position", 3)),
            (OutputMode.VELOCITY, 0, Field("velocity_m_s", 3)),
            (OutputMode.STATUS, 0, Field("status", 1, _U1)),
        )
        return [field for part, off, field in parts if self.mode & part and not self.settings & off]

    def _width(self, field: Field) -> int:
        one = self.number_format.size if field.kind == "real" else np.dtype(field.kind).itemsize
        return one * field.count

    @cached_property
    def size(self) -> int:
        """Bytes of the payload."""
        return sum(self._width(field) for field in self.fields)

    def decode(self, payloads: bytes | ByteArray) -> Values:
        """Values of one payload, or of many of them as rows of bytes, shape (n, size).

        Raises
        ------
        MismatchError
            If the payload is not `size` bytes long.
        """
        rows = np.atleast_2d(np.frombuffer(payloads, np.uint8) if isinstance(payloads, bytes) else payloads)
        if rows.shape[1] != self.size:
            raise MismatchError(
                f"MTData of mode {self.mode:#06x}: expected {self.size} bytes, got {rows.shape[1]}"
            )
        values, at = {}, 0
        for field in self.fields:
            width = self._width(field)
            values[field.name] = self._decoded(field, rows[:, at : at + width])
            at += width
        return values

    def _decoded(self, field: Field, rows: ByteArray) -> FloatArray:
        if field.kind == "real":
            return numbers_from_bytes(rows, self.number_format)
        return np.ascontiguousarray(rows).view(field.kind).astype(np.float64)
