"""What the legacy data message MTData carries: raw counts, calibrated values, orientation.

Nothing in the message says how it is laid out; output mode and settings do, from the configuration or from
whoever set them. A unit on a bus with a master, and the MT9-B, put the counter first instead of last.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from functools import cached_property

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from xsens.messages.numberformats import NumberFormat, bytes_from_numbers, numbers_from_bytes

Values = dict[str, npt.NDArray[np.float64]]
"""Field name to values, shape (n, count); whole numbers are exact."""


class OutputMode(IntFlag):
    """What the sensor sends."""

    TEMPERATURE = 0x0001
    CALIBRATED = 0x0002
    ORIENTATION = 0x0004
    AUXILIARY = 0x0008
    POSITION = 0x0010
    VELOCITY = 0x0020
    STATUS = 0x0800
    RAW = 0x4000
    MT9 = 0x8000
    """The MT9-B's raw record, its counter first."""


class OutputSettings(IntFlag):
    """In what manner; orientation and number format are fields of two bits, for which see `DataLayout`."""

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
    """One run of values in a message: `kind` is real, or a numpy type of big-endian whole numbers."""

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
_UTC = (
    Field("utc_nanosecond", 1, ">u4"),
    Field("utc_year", 1, _U2),
    Field("utc_month_to_second", 5, _U1),
    Field("utc_valid", 1, _U1),
)
_ORIENTATION = (Field("quaternion_wxyz", 4), Field("euler_deg", 3), Field("matrix", 9))


@dataclass(frozen=True)
class DataLayout:
    """Which fields follow one another in an MTData payload.

    Attributes
    ----------
    mode, settings : int
        See `OutputMode` and `OutputSettings`.
    counter_first : bool
        As from a unit behind a master; always so in mode `OutputMode.MT9`.

    Raises
    ------
    InvalidInputError
        If the mode asks for nothing, or for raw counts together with anything else.
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
        """How real numbers are written."""
        return NumberFormat((self.settings >> 8) & 3)

    @property
    def frame(self) -> str:
        """World of the orientation: NWU, or NED if so set."""
        return "NED" if self.settings & OutputSettings.NED else "NWU"

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """In the order of the message."""
        if self.mode == OutputMode.MT9:
            return (_COUNTER, *_RAW)
        counter = (_COUNTER,) if self.settings & OutputSettings.COUNTER else ()
        utc = _UTC if self.settings & OutputSettings.UTC else ()
        body = _RAW if self.mode == OutputMode.RAW else tuple(self._measured())
        return (*counter, *body, *utc) if self.counter_first else (*body, *counter, *utc)

    def _measured(self) -> list[Field]:
        wanted = (
            (self._has(OutputMode.TEMPERATURE), Field("temperature_c", 1)),
            (self._calibrated(OutputSettings.NO_ACCELEROMETER), Field("accelerometer_m_s2", 3)),
            (self._calibrated(OutputSettings.NO_GYROSCOPE), Field("gyroscope_rad_s", 3)),
            (self._calibrated(OutputSettings.NO_MAGNETOMETER), Field("magnetometer_au", 3)),
            (self._has(OutputMode.ORIENTATION), _ORIENTATION[(self.settings >> 2) & 3]),
            (self._analog(OutputSettings.NO_ANALOG_1), Field("analog_1", 1, _U2)),
            (self._analog(OutputSettings.NO_ANALOG_2), Field("analog_2", 1, _U2)),
            (self._has(OutputMode.POSITION), Field("position", 3)),
            (self._has(OutputMode.VELOCITY), Field("velocity_m_s", 3)),
            (self._has(OutputMode.STATUS), Field("status", 1, _U1)),
        )
        return [field for there, field in wanted if there]

    def _has(self, part: OutputMode) -> bool:
        return bool(self.mode & part)

    def _calibrated(self, disabled: OutputSettings) -> bool:
        return self._has(OutputMode.CALIBRATED) and not self.settings & disabled

    def _analog(self, disabled: OutputSettings) -> bool:
        return self._has(OutputMode.AUXILIARY) and not self.settings & disabled

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

    def _decoded(self, field: Field, rows: ByteArray) -> npt.NDArray[np.float64]:
        if field.kind == "real":
            return numbers_from_bytes(rows, self.number_format)
        return np.ascontiguousarray(rows).view(field.kind).astype(np.float64)

    def encode(self, values: Mapping[str, npt.ArrayLike]) -> ByteArray:
        """Payloads as rows of bytes, shape (n, size), from values of shape (n, count) by field name.

        Raises
        ------
        InvalidInputError
            If a field is missing, has another shape, or does not fit its format.
        """
        parts = []
        for field in self.fields:
            if field.name not in values:
                raise InvalidInputError(f"MTData of mode {self.mode:#06x}: expected {field.name}, got none")
            parts.append(self._encoded(field, np.atleast_2d(np.asarray(values[field.name], dtype=float))))
        if len({len(part) for part in parts}) > 1:
            raise InvalidInputError("MTData: expected as many rows of every field")
        return np.concatenate(parts, axis=1)

    def _encoded(self, field: Field, array: npt.NDArray[np.float64]) -> ByteArray:
        if array.ndim != 2 or array.shape[1] != field.count:
            raise InvalidInputError(f"{field.name}: expected shape (n, {field.count}), got {array.shape}")
        if field.kind == "real":
            return bytes_from_numbers(array, self.number_format)
        most = np.iinfo(field.kind).max
        if not ((array >= 0) & (array <= most) & (array == np.floor(array))).all():
            raise InvalidInputError(f"{field.name}: expected whole numbers from 0 to {most}")
        return np.ascontiguousarray(array.astype(field.kind)).view(np.uint8)
