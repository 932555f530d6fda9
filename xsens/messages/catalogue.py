"""What the messages are called, when they may be sent, and what the short ones say.

Of request and reply, the reply's id is one more. Measured data are in `xsens.messages.mtdata` (legacy) and
`xsens.messages.mtdata2`; framing is in `xsens.messages.framing`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from enum import Enum, IntEnum

from speckle3d.core.errors import InvalidInputError
from xsens.messages.framing import MASTER, Framer, Frames, Message, decode, encode, find_frames

__all__ = [
    "BAUD_CODES",
    "MASTER",
    "NOT_OUTPUT_BUT_ASKED_FOR",
    "Configuration",
    "Framer",
    "Frames",
    "Message",
    "MessageId",
    "OutputItem",
    "State",
    "UnitConfiguration",
    "decode",
    "device_id",
    "encode",
    "error_of",
    "find_frames",
    "output_configuration",
    "reply_to",
    "request_of",
    "set_output_configuration",
    "state_after",
    "valid_in",
]

BASE_RATE_HZ = 115200
"""Ticks per second of the sampling period."""

NOT_OUTPUT_BUT_ASKED_FOR = 0xFFFF
"""Skip factor with which the sensor sends data only on `MessageId.REQ_DATA`."""

BAUD_CODES = {
    460800: 0x00,
    230400: 0x01,
    115200: 0x02,
    76800: 0x03,
    57600: 0x04,
    38400: 0x05,
    28800: 0x06,
    19200: 0x07,
    14400: 0x08,
    9600: 0x09,
    921600: 0x80,
}
"""What the sensors call their baud rates."""


class MessageId(IntEnum):
    """Message ids, of requests and data; a reply's is one more than its request's."""

    REQ_DID = 0x00
    DEVICE_ID = 0x01
    INIT_MT = 0x02
    INIT_MT_RESULTS = 0x03
    PERIOD = 0x04
    REQ_CONFIGURATION = 0x0C
    CONFIGURATION = 0x0D
    RESTORE_FACTORY_DEFAULTS = 0x0E
    GO_TO_MEASUREMENT = 0x10
    GO_TO_MEASUREMENT_ACK = 0x11
    REQ_FW_REV = 0x12
    FIRMWARE_REV = 0x13
    BAUD_RATE = 0x18
    REQ_PRODUCT_CODE = 0x1C
    PRODUCT_CODE = 0x1D
    GO_TO_CONFIG = 0x30
    GO_TO_CONFIG_ACK = 0x31
    MT_DATA = 0x32
    REQ_DATA = 0x34
    REQ_DATA_ACK = 0x35
    MT_DATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACK = 0x3F
    RESET = 0x40
    RESET_ACK = 0x41
    ERROR = 0x42
    FILTER_PROFILE = 0x64
    REQ_EMTS = 0x90
    EMTS = 0x91
    RESET_ORIENTATION = 0xA4
    OUTPUT_CONFIGURATION = 0xC0
    OUTPUT_CONFIGURATION_ACK = 0xC1
    OUTPUT_MODE = 0xD0
    OUTPUT_MODE_ACK = 0xD1
    OUTPUT_SETTINGS = 0xD2
    OUTPUT_SETTINGS_ACK = 0xD3
    SKIP_FACTOR = 0xD4
    SKIP_FACTOR_ACK = 0xD5


class State(Enum):
    """What the sensor is doing: it takes settings in the one state and sends data in the other."""

    CONFIGURATION = "configuration"
    MEASUREMENT = "measurement"


_IN_BOTH = {MessageId.GO_TO_CONFIG, MessageId.RESET, MessageId.RESET_ORIENTATION, MessageId.REQ_DID}
_WHILE_MEASURING = {MessageId.REQ_DATA}
_STATE_AFTER: dict[int, State] = {
    MessageId.GO_TO_MEASUREMENT_ACK: State.MEASUREMENT,
    MessageId.MT_DATA: State.MEASUREMENT,
    MessageId.MT_DATA2: State.MEASUREMENT,
    MessageId.WAKE_UP_ACK: State.CONFIGURATION,
    MessageId.GO_TO_CONFIG_ACK: State.CONFIGURATION,
}


def valid_in(request: int, state: State) -> bool:
    """Whether the sensor heeds `request`, a message id, in `state`."""
    if request in _IN_BOTH:
        return True
    return (request in _WHILE_MEASURING) == (state is State.MEASUREMENT)


def state_after(message: Message, state: State) -> State:
    """The sensor's state once it has sent `message`, `state` being the one before."""
    return _STATE_AFTER.get(message.mid, state)


def reply_to(request: int) -> int:
    """Message id of the answer to `request`."""
    return request + 1


def request_of(message: Message) -> int | None:
    """Which request `message` answers; None if it is data, an error or unasked for."""
    unasked = {MessageId.MT_DATA, MessageId.MT_DATA2, MessageId.ERROR, MessageId.WAKE_UP}
    return None if message.mid in unasked or message.mid % 2 == 0 else message.mid - 1


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
    """What an error message of the sensor says."""
    code = _exactly(message, 1)[0]
    return f"error {code}: {_ERRORS.get(code, 'not documented')}"


def device_id(message: Message) -> int:
    """The unit's number, from any message that begins with it (DeviceID, InitMTResults, configuration)."""
    return int.from_bytes(_at_least(message, 4)[:4], "big")


@dataclass(frozen=True)
class UnitConfiguration:
    """What one unit sends.

    Attributes
    ----------
    device_id : int
    data_length : int
        Bytes of its part of an MTData message.
    output_mode, output_settings : int
        See `xsens.messages.mtdata`.
    reserved : bytes
        Eight bytes whose meaning is not documented, kept.
    """

    device_id: int
    data_length: int
    output_mode: int
    output_settings: int
    reserved: bytes = bytes(8)


_HEAD = struct.Struct(">IHHHHI8s8s32s32sH")
_UNIT = struct.Struct(">IHHI8s")


@dataclass(frozen=True)
class Configuration:
    """Answer to `MessageId.REQ_CONFIGURATION`.

    Attributes
    ----------
    device_id : int
        Of the unit, or of the master where there are several.
    period : int
        Of sampling, in 1/115200 s.
    skip_factor : int
        Samples left out between two that are sent.
    units : tuple of UnitConfiguration
    sync_mode, sync_skip, sync_offset : int
    date, time : bytes
        Of the recording, as text; zero bytes if not set.
    reserved : tuple of bytes
        Two runs of 32 bytes.
    """

    device_id: int
    period: int
    skip_factor: int
    units: tuple[UnitConfiguration, ...]
    sync_mode: int = 0
    sync_skip: int = 0
    sync_offset: int = 0
    date: bytes = bytes(8)
    time: bytes = bytes(8)
    reserved: tuple[bytes, bytes] = (bytes(32), bytes(32))

    @property
    def rate_hz(self) -> float:
        """Messages per second; NaN if sent only when asked for."""
        if self.period == 0 or self.skip_factor == NOT_OUTPUT_BUT_ASKED_FOR:
            return float("nan")
        return BASE_RATE_HZ / (self.period * (self.skip_factor + 1))

    @classmethod
    def from_message(cls, message: Message) -> Configuration:
        """Decode; raises `InvalidInputError` if the length does not suit the number of units."""
        head = _HEAD.unpack(_at_least(message, _HEAD.size)[: _HEAD.size])
        count = head[-1]
        payload = _exactly(message, _HEAD.size + count * _UNIT.size)
        units = tuple(UnitConfiguration(*fields) for fields in _UNIT.iter_unpack(payload[_HEAD.size :]))
        number, period, skip, mode, sync_skip, offset, date, time, first, second, _ = head
        return cls(number, period, skip, units, mode, sync_skip, offset, date, time, (first, second))

    def message(self) -> Message:
        """Encode."""
        head = (self.device_id, self.period, self.skip_factor, self.sync_mode, self.sync_skip)
        texts = (self.sync_offset, self.date, self.time, *self.reserved, len(self.units))
        units = (
            _UNIT.pack(u.device_id, u.data_length, u.output_mode, u.output_settings, u.reserved)
            for u in self.units
        )
        return Message(MessageId.CONFIGURATION, _HEAD.pack(*head, *texts) + b"".join(units))

    def with_output(self, mode: int, settings: int, data_length: int) -> Configuration:
        """The same with every unit set to send `mode` in the manner of `settings`."""
        units = (
            replace(u, output_mode=mode, output_settings=settings, data_length=data_length)
            for u in self.units
        )
        return replace(self, units=tuple(units))


@dataclass(frozen=True)
class OutputItem:
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
    """What an MTData2 sensor says, or is told, to send."""
    if len(message.payload) % 4:
        raise InvalidInputError(
            f"output configuration: expected whole items of 4 bytes, got {len(message.payload)} bytes"
        )
    return tuple(OutputItem(*item) for item in struct.iter_unpack(">HH", message.payload))


def set_output_configuration(items: tuple[OutputItem, ...]) -> Message:
    """Tell an MTData2 sensor what to send; without items, ask it."""
    payload = b"".join(struct.pack(">HH", item.identifier, item.rate_hz) for item in items)
    return Message(MessageId.OUTPUT_CONFIGURATION, payload)


def _at_least(message: Message, size: int) -> bytes:
    if len(message.payload) < size:
        raise InvalidInputError(
            f"message {message.mid:#04x}: expected at least {size} bytes, got {len(message.payload)}"
        )
    return message.payload


def _exactly(message: Message, size: int) -> bytes:
    if len(message.payload) != size:
        raise InvalidInputError(
            f"message {message.mid:#04x}: expected {size} bytes, got {len(message.payload)}"
        )
    return message.payload
