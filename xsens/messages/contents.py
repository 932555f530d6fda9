"""Content of messages: ids, configurations, calibrations and the time; and data, legacy and MTData2.

MTData's layout is by output mode and settings, known from the configuration or from whoever set them; the
MT9-B puts the counter first instead of last. MTData2 has items of identifier, size and data: the last four
bits of an identifier give the format of its real numbers and their world, ENU, NED or NWU. Items without a
measurement or a time stamp, or of another length than they should have, are passed over.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum, IntFlag
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from speckle3d.core.arrays import AnyArray, BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.messages.framing import Frames, Message, rows_at

BASE_RATE_HZ = 115200
"""Ticks per second of the sampling period."""

_ON_REQUEST = 0xFFFF
"""Skip factor of a sensor that sends data only when it is asked for them."""


class MessageId(IntEnum):
    """Ids of requests and data, and of those replies that are read; a reply's is its request's plus one."""

    REQ_DID = 0x00
    PERIOD = 0x04
    REQ_CONFIGURATION = 0x0C
    CONFIGURATION = 0x0D
    GO_TO_MEASUREMENT = 0x10
    GO_TO_CONFIG = 0x30
    MT_DATA = 0x32
    MT_DATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACK = 0x3F
    ERROR = 0x42
    UTC_TIME = 0x61
    REQ_EMTS = 0x90
    EMTS = 0x91
    OUTPUT_CONFIGURATION = 0xC0
    OUTPUT_MODE = 0xD0
    OUTPUT_SETTINGS = 0xD2
    SKIP_FACTOR = 0xD4


DATA = (MessageId.MT_DATA, MessageId.MT_DATA2)


def rate_of(period: int) -> float:
    """Rate in Hz by a period in ticks; NaN if it is zero."""
    return BASE_RATE_HZ / period if period else np.nan


_HEAD = struct.Struct(">4xHH88xH")
"""Period, skip factor, number of units; serial number, synchronisation, date and time are not read."""

_UNIT = struct.Struct(">6xHI8x")


class Configuration(NamedTuple):
    """Messages per second (NaN if they are sent only on request), and units: several behind a master.

    A unit is its output mode and settings, as `DataLayout` has them.
    """

    rate_hz: float
    units: tuple[tuple[int, int], ...]

    @classmethod
    def from_message(cls, message: Message) -> Configuration:
        """Decode; raises `InvalidInputError` if the length does not suit the number of units."""
        payload = message.payload
        period, skip, count = _HEAD.unpack_from(payload.ljust(_HEAD.size, b"\0"))
        if len(payload) != _HEAD.size + count * _UNIT.size:
            raise InvalidInputError(
                f"configuration: expected {_HEAD.size} bytes and {_UNIT.size} for each of {count} units, "
                f"got {len(payload)}"
            )
        units: Any = tuple(_UNIT.iter_unpack(payload[_HEAD.size :]))
        return cls(rate_of(0 if skip == _ON_REQUEST else period * (skip + 1)), units)


_UTC = struct.Struct(">IH6B")
_UTC_ALL_VALID = 7


def utc_message(moment: datetime | None = None) -> Message:
    """The computer's time in the form in which the sensors send theirs; now by default."""
    t = moment or datetime.now(UTC)
    fields = (t.microsecond * 1000, t.year, t.month, t.day, t.hour, t.minute, t.second, _UTC_ALL_VALID)
    return Message(MessageId.UTC_TIME, _UTC.pack(*fields))


def utc_time_s(message: Message) -> float:
    """Seconds since 1970 of a UTC message; NaN if it holds no valid date."""
    if len(message.payload) != _UTC.size:
        return np.nan
    nanosecond, year, month, day, hour, minute, second, _ = _UTC.unpack(message.payload)
    try:
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        return float(whole.timestamp() + nanosecond * 1e-9)
    except (ValueError, OverflowError):
        return np.nan


# -- calibration of raw counts
#
# The layout of the block that a sensor keeps, and its logs begin with, is not published; it was found by
# comparing logs with gravity. A vector of counts u becomes M^-1 ((u - b) / g). Parts of the block are not
# understood, among them most likely the dependence on temperature: expect an error of about 1 % of gravity.

BLOCK_SIZE = 168
"""Bytes of the payload; blocks of later sensors are longer, in an unknown layout."""

COMPENSATION_NOTE = (
    "raw counts: dependence on temperature is not compensated (expect about 1 % of gravity), "
    "nor the housing's alignment applied"
)

_BLOCK = np.dtype(
    {
        "names": ("inertial", "period", "offsets", "gains", "magnetic"),
        "formats": ((">i2", (2, 3, 3)), ">u2", (">u2", (3, 3)), ("u1", (3, 3, 3)), (">i2", (3, 3))),
        "offsets": (8, 81, 87, 105, 132),
        "itemsize": BLOCK_SIZE,
    }
)
"""Misalignments of accelerometer and gyroscope, and of the magnetometer, over 2**14; gains over 2**8."""


@dataclass(frozen=True)
class RawCalibration:
    """The understood part of a unit's calibration block.

    Attributes
    ----------
    rate_hz : float
        Samples per second; NaN if the block does not hold the period.
    offsets : ndarray, shape (3, 3)
        Counts at zero of accelerometer, gyroscope and magnetometer, each x, y, z.
    gains : ndarray, shape (3, 3)
        Counts per m/s², rad/s and unit of field.
    misalignments : ndarray, shape (3, 3, 3)
        ``sensing axes from sensor axes`` of each of the three sensors.

    Raises
    ------
    InvalidInputError
        If a gain is zero or a misalignment cannot be inverted.
    """

    rate_hz: float
    offsets: FloatArray
    gains: FloatArray
    misalignments: FloatArray

    def __post_init__(self) -> None:
        # Axes of a real unit are within a few degrees of square: a determinant near 1.
        worst = np.abs(np.linalg.det(self.misalignments)).min()
        if worst < 0.1 or not self.gains.all():
            raise InvalidInputError(
                f"calibration block: expected gains and axes nearly square, got determinant {worst:.2g}"
            )

    @classmethod
    def from_message(cls, message: Message) -> RawCalibration:
        """Decode an eMTS message of `BLOCK_SIZE` bytes."""
        block = np.frombuffer(message.payload, _BLOCK)[0]
        return cls(
            rate_of(int(block["period"])),
            block["offsets"].astype(float),
            block["gains"] @ [256.0, 1.0, 1.0 / 256.0],
            np.concatenate((block["inertial"], block["magnetic"][None])) / 2.0**14,
        )

    def to_units(self, sensor: int, counts: FloatArray) -> Any:
        """Acceleration in m/s², rate in rad/s or field in arbitrary units, of counts, shape (n, 3)."""
        axes = (np.linalg.inv(self.misalignments[sensor]) / self.gains[sensor]).T
        return (counts - self.offsets[sensor]) @ axes


# -- data messages

Values = dict[str, FloatArray]
"""Field name to values, shape (n, count); whole numbers are exact."""

REAL = (">f4", ">i4", ">u4,>i2", ">f8")
"""NumPy types of real numbers by the vendor's two-bit fields; all values are exact as float64.

The second is over 2**20; the third a 48-bit integer over 2**32, its fraction before its whole part.
"""


def as_floats(numbers: AnyArray) -> FloatArray:
    """Float64 of numbers of one of the types in `REAL`, or of unsigned whole numbers."""
    if numbers.dtype == REAL[1]:
        return numbers / 2.0**20
    if numbers.dtype == np.dtype(REAL[2]):
        return numbers["f1"] + numbers["f0"] / 2.0**32
    with np.errstate(invalid="ignore"):  # signalling NaNs, which damage can make
        return numbers.astype(np.float64)


class OutputMode(IntFlag):
    """Parts that are asked for or told apart; all are in `_PARTS`."""

    CALIBRATED = 0x0002
    ORIENTATION = 0x0004
    RAW = 0x4000
    MT9 = 0x8000
    """The MT9-B's raw record, which begins with the counter."""


class OutputSettings(IntFlag):
    """Options; orientation and number format are fields of two bits, see `DataLayout`."""

    COUNTER = 0x1
    UTC = 0x2
    NED = 0x80000000


@dataclass(frozen=True)
class Field:
    """A run of values in a message, of a NumPy type; an empty one is real, in the message's format."""

    name: str
    count: int
    whole: str = ""


_RAW = (
    Field("raw_accelerometer", 3, ">u2"),
    Field("raw_gyroscope", 3, ">u2"),
    Field("raw_magnetometer", 3, ">u2"),
    Field("raw_temperature", 1, ">u2"),
)
_COUNTER = Field("counter", 1, ">u2")
_ORIENTATION = (Field("quaternion_wxyz", 4), Field("euler_deg", 3), Field("matrix", 9), None)
_PARTS = (
    (0x0001, 0, Field("temperature_c", 1)),
    (OutputMode.CALIBRATED, 0x10, Field("accelerometer_m_s2", 3)),
    (OutputMode.CALIBRATED, 0x20, Field("gyroscope_rad_s", 3)),
    (OutputMode.CALIBRATED, 0x40, Field("magnetometer_au", 3)),
    (OutputMode.ORIENTATION, 0, None),
    (0x0008, 0x400, Field("analog_1", 1, ">u2")),
    (0x0008, 0x800, Field("analog_2", 1, ">u2")),
    (0x0010, 0, Field("position", 3)),
    (0x0020, 0, Field("velocity_m_s", 3)),
    (0x0800, 0, Field("status", 1, ">u1")),
)
"""Bit of the mode, the setting that leaves the field out, and the field (None: by the settings), in order."""


@dataclass(frozen=True)
class DataLayout:
    """Order of the fields in an MTData payload.

    Attributes
    ----------
    mode, settings : int
        See `OutputMode` and `OutputSettings`; bits 2 and 3 of the settings choose quaternion, Euler angles or
        matrix, bits 8 and 9 the type of real numbers (`REAL`).

    Raises
    ------
    InvalidInputError
        If mode or settings are not possible, or leave no field.
    """

    mode: int
    settings: int = OutputSettings.COUNTER

    def __post_init__(self) -> None:
        if (self.settings >> 2) & 3 == 3 or not self.fields:
            raise InvalidInputError(
                f"expected output mode and settings of some known output, got {self.mode:#x}, "
                f"{self.settings:#x}"
            )

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
        utc = (Field("utc", 12, ">u1"),) if self.settings & OutputSettings.UTC else ()
        orientation = _ORIENTATION[(self.settings >> 2) & 3]
        calibrated = (
            field or orientation
            for part, off, field in _PARTS
            if self.mode & part and not self.settings & off
        )
        return (*(_RAW if self.mode == OutputMode.RAW else calibrated), *counter, *utc)

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The payload as a NumPy structure."""
        real = REAL[(self.settings >> 8) & 3]
        return np.dtype([(field.name, field.whole or real, (field.count,)) for field in self.fields])

    def decode(self, frames: Frames, name: str) -> AnyArray:
        """Numbers of a field in messages of this layout, shape (n, count); for `as_floats`."""
        kind, offset = self.dtype.fields[name][:2]  # type: ignore[index]
        return rows_at(frames.data, frames.payload_start + offset, kind.itemsize).view(kind.base)


# -- MTData2: messages that describe themselves

_ITEMS = {
    0x1020: Field("counter", 1, ">u2"),
    0x1060: Field("ticks", 1, ">u4"),
    0x2010: Field("quaternion_wxyz", 4),
    0x2020: Field("matrix", 9),
    0x2030: Field("euler_deg", 3),
    0x4010: Field("delta_v_m_s", 3),
    0x4020: Field("accelerometer_m_s2", 3),
    0x8020: Field("gyroscope_rad_s", 3),
    0x8030: Field("delta_q_wxyz", 4),
    0xC020: Field("magnetometer_au", 3),
}
"""Identifiers of the vendor's list that are read."""

KINDS = {first + k: kind for first, kind in _ITEMS.items() for k in range(1 if kind.whole else 12)}
"""Those of all formats (two bits) and worlds (two above them) of real numbers as well."""

_WORLDS = ("ENU", "NED", "NWU")


def read_items(frames: Frames) -> tuple[Values, str, BoolArray, BoolArray]:
    """Take all messages apart side by side: their first items, their second ones, and so on.

    Orientations in another world than the first are left out.

    Returns
    -------
    mapping of str to ndarray, shape (m, count)
        Numbers of the m messages by name, NaN where missing.
    str
        World of the orientations, "" without.
    ndarray of bool, shape (m,)
        Messages with more than time stamps.
    ndarray of bool, shape (m,)
        Damage: those whose last item claims more bytes than there are. Of them nothing is read.
    """
    values: Values = {}
    world = ""
    is_sample, damage = np.zeros((2, len(frames)), dtype=bool)
    data, rows, at, end = frames.data, np.arange(len(frames)), frames.payload_start, frames.end - 1
    while (left := at < end).any():
        rows, at, end = rows[left], at[left], end[left]
        identifiers = rows_at(data, at, 2).view(">u2")[:, 0]
        sizes = data.take(at + 2, mode="clip")  # behind a last identifier the data may end
        after = at + 3 + sizes
        damage[rows[after > end]] = True
        for identifier in np.unique(identifiers).tolist():
            if (kind := KINDS.get(identifier)) is None:
                continue
            number = np.dtype(kind.whole or REAL[identifier & 3])
            size = kind.count * number.itemsize
            matches = (identifiers == identifier) & (sizes == size) & (after <= end)
            if not matches.any():
                continue
            is_sample[rows[matches]] |= not kind.whole
            if identifier >> 12 == 2:  # an orientation
                frame = _WORLDS[identifier >> 2 & 3]
                world = world or frame
                if frame != world:
                    continue
            if kind.name not in values:
                values[kind.name] = np.full((len(frames), kind.count), np.nan)
            values[kind.name][rows[matches]] = as_floats(rows_at(data, at[matches] + 3, size).view(number))
        at = after
    is_sample &= ~damage
    if "matrix" in values:  # sent column by column
        values["matrix"] = values["matrix"].reshape(-1, 3, 3).swapaxes(1, 2).reshape(-1, 9)
    for column in values.values():
        column[damage] = np.nan
    return values, world, is_sample, damage
