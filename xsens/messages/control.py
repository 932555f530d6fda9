"""Message ids, and the content of control messages: errors, device ids, configurations.

Measured data are in `xsens.messages.mtdata` (legacy) and `xsens.messages.mtdata2`; framing is in
`xsens.messages.framing`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum
from typing import NamedTuple

from speckle3d.core.errors import InvalidInputError
from xsens.messages.framing import Message

BASE_RATE_HZ = 115200
"""Ticks per second of the sampling period."""

NOT_OUTPUT_BUT_ASKED_FOR = 0xFFFF
"""Skip factor with which the sensor sends data only in answer to `MessageId.REQ_DATA`."""


class MessageId(IntEnum):
    """Message ids of requests, replies and data; a reply's is its request's plus one."""

    REQ_DID = 0x00
    DEVICE_ID = 0x01
    INIT_MT_RESULTS = 0x03
    PERIOD = 0x04
    REQ_CONFIGURATION = 0x0C
    CONFIGURATION = 0x0D
    GO_TO_MEASUREMENT = 0x10
    GO_TO_MEASUREMENT_ACK = 0x11
    GO_TO_CONFIG = 0x30
    GO_TO_CONFIG_ACK = 0x31
    MT_DATA = 0x32
    REQ_DATA = 0x34
    MT_DATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACK = 0x3F
    ERROR = 0x42
    UTC_TIME = 0x61
    REQ_EMTS = 0x90
    EMTS = 0x91
    RESET_ORIENTATION = 0xA4
    OUTPUT_CONFIGURATION = 0xC0
    OUTPUT_CONFIGURATION_ACK = 0xC1
    OUTPUT_MODE = 0xD0
    OUTPUT_SETTINGS = 0xD2
    SKIP_FACTOR = 0xD4


_ERRORS = {
    3: "the period is not within the valid range",
    4: "the message is not valid, or not in this state",
    24: "the period is too short to collect all data",
    30: "timer overflow: the sensor cannot keep up with its settings",
    32: "the baud rate is not valid",
    33: "a parameter is not valid",
    40: "the device failed",
}


def error_of(message: Message) -> str:
    """Text of an error message of the sensor."""
    code = _payload(message, 1)[0]
    return f"error {code}: {_ERRORS.get(code, 'not documented')}"


def device_id(message: Message) -> int:
    """Serial number of the unit, from a message that begins with it (DeviceID, configuration)."""
    return int.from_bytes(_payload(message, 4, at_least=True)[:4], "big")


@dataclass(frozen=True)
class UnitConfiguration:
    """Output of one unit.

    Attributes
    ----------
    device_id : int
    data_length : int
        Bytes of the unit's part of an MTData message.
    output_mode, output_settings : int
        See `xsens.messages.mtdata`.
    """

    device_id: int
    data_length: int
    output_mode: int
    output_settings: int


_HEAD = struct.Struct(">IHH88xH")
"""Device, period, skip factor; synchronisation, date and time, which are not read; number of units."""

_UNIT = struct.Struct(">IHHI8x")


@dataclass(frozen=True)
class Configuration:
    """Answer to `MessageId.REQ_CONFIGURATION`.

    Attributes
    ----------
    device_id : int
        Of the unit, or of the master if there are several units.
    period : int
        Sampling period, in 1/115200 s.
    skip_factor : int
        Samples left out between two that are sent.
    units : tuple of UnitConfiguration
    """

    device_id: int
    period: int
    skip_factor: int
    units: tuple[UnitConfiguration, ...]

    @property
    def rate_hz(self) -> float:
        """Messages per second; NaN if they are sent only on request."""
        if self.period == 0 or self.skip_factor == NOT_OUTPUT_BUT_ASKED_FOR:
            return float("nan")
        return BASE_RATE_HZ / (self.period * (self.skip_factor + 1))

    @classmethod
    def from_message(cls, message: Message) -> Configuration:
        """Decode; raises `InvalidInputError` if the length does not suit the number of units."""
        number, period, skip, count = _HEAD.unpack_from(_payload(message, _HEAD.size, at_least=True))
        payload = _payload(message, _HEAD.size + count * _UNIT.size)
        units = tuple(UnitConfiguration(*fields) for fields in _UNIT.iter_unpack(payload[_HEAD.size :]))
        return cls(number, period, skip, units)


class OutputItem(NamedTuple):
    """One line of an MTData2 sensor's output configuration.

    Attributes
    ----------
    identifier : int
        See `xsens.messages.mtdata2`.
    rate_hz : int
        65535 for as often as there is a message.
    """

    identifier: int
    rate_hz: int


def output_configuration(message: Message) -> tuple[OutputItem, ...]:
    """Items that an MTData2 sensor is configured to send, from its answer or a request."""
    if len(message.payload) % 4:
        raise InvalidInputError(
            f"output configuration: expected whole items of 4 bytes, got {len(message.payload)} bytes"
        )
    return tuple(map(OutputItem._make, struct.iter_unpack(">HH", message.payload)))


def set_output_configuration(items: tuple[OutputItem, ...]) -> Message:
    """Request that sets the items an MTData2 sensor sends; without items, one that asks for them."""
    payload = b"".join(struct.pack(">HH", *item) for item in items)
    return Message(MessageId.OUTPUT_CONFIGURATION, payload)


_UTC = struct.Struct(">IH6B")
_UTC_ALL_VALID = 7


def utc_message(now: datetime | None = None) -> Message:
    """The computer's time in the form in which the sensors send theirs; now by default."""
    t = now or datetime.now(UTC)
    fields = (t.microsecond * 1000, t.year, t.month, t.day, t.hour, t.minute, t.second, _UTC_ALL_VALID)
    return Message(MessageId.UTC_TIME, _UTC.pack(*fields))


def utc_time_s(message: Message) -> float:
    """Seconds since 1970 of a UTC message; NaN if it is another one or holds no valid date."""
    if message.mid != MessageId.UTC_TIME or len(message.payload) != _UTC.size:
        return float("nan")
    nanosecond, year, month, day, hour, minute, second, _ = _UTC.unpack(message.payload)
    try:
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        return float(whole.timestamp() + nanosecond * 1e-9)
    except (ValueError, OverflowError):
        return float("nan")


def _payload(message: Message, size: int, at_least: bool = False) -> bytes:
    """Payload of a message; raise unless it is of that size."""
    found = len(message.payload)
    if found < size or (found > size and not at_least):
        least = "at least " if at_least else ""
        raise InvalidInputError(f"message {message.mid:#04x}: expected {least}{size} bytes, got {found}")
    return message.payload
