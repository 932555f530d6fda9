"""Message ids, and the content of control messages: configurations, calibrations, the time.

Measured data are in `xsens.messages.mtdata`; framing is in
`xsens.messages.framing`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.messages.framing import Message

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
    return BASE_RATE_HZ / period if period else float("nan")


_HEAD = struct.Struct(">4xHH88xH")
"""Period, skip factor, number of units; serial number, synchronisation, date and time are not read."""

_UNIT = struct.Struct(">6xHI8x")


class Configuration(NamedTuple):
    """Messages per second (NaN if they are sent only on request), and units: several behind a master.

    A unit is its output mode and settings, as `xsens.messages.mtdata.DataLayout` has them.
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
        return float("nan")
    nanosecond, year, month, day, hour, minute, second, _ = _UTC.unpack(message.payload)
    try:
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        return float(whole.timestamp() + nanosecond * 1e-9)
    except (ValueError, OverflowError):
        return float("nan")


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

    def to_units(self, sensor: int, counts: FloatArray) -> FloatArray:
        """Acceleration in m/s², rate in rad/s or field in arbitrary units, of counts, shape (n, 3)."""
        axes = (np.linalg.inv(self.misalignments[sensor]) / self.gains[sensor]).T
        return np.asarray((counts - self.offsets[sensor]) @ axes)
