"""Find, configure, start and stop a live sensor on a serial port.

The sensor is in one of two states: in one it takes settings, in the other it sends data. It is always brought
to take settings first; data that arrive meanwhile are ignored.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from speckle3d.core.errors import FileError, InvalidInputError
from speckle3d.core.extras import extra_module
from xsens.messages.contents import BASE_RATE_HZ, Configuration, MessageId, OutputMode, OutputSettings
from xsens.messages.framing import Framer, Message, encode

if TYPE_CHECKING:
    from serial import Serial

COMMON_BAUD = (115200, 921600, 460800, 230400, 57600)
"""Order in which rates are tried: the factory setting, then faster ones, which are set more often."""

ANSWER_S = 0.5
"""Time for an answer: a sensor takes a few milliseconds, an adapter's driver may add 16."""

_POLL_S = 0.05
_TRIES = 3
_EVERY = 0xFFFF
"""Rate of an MTData2 item that is sent as often as there is a message."""

_VECTOR_ITEMS = (0x4020, 0x8020, 0xC020)
_CONTENTS = {
    "as set": (0, ()),
    "raw": (OutputMode.RAW, (0xA010,)),
    "calibrated": (OutputMode.CALIBRATED, _VECTOR_ITEMS),
    "orientation": (OutputMode.CALIBRATED | OutputMode.ORIENTATION, (0x2010, *_VECTOR_ITEMS)),
}
"""Output mode of an MTData sensor and items of an MTData2 one."""

_COUNTER, _TIME, _STATUS = 0x1020, 0x1060, 0xE020


class DeviceError(FileError):
    """The sensor is not there, does not answer, or refuses a setting."""


@dataclass(frozen=True)
class DeviceSettings:
    """Output of the sensor, and the speed of the line.

    Attributes
    ----------
    content : str
        ``"orientation"``: the sensor's own orientation and calibrated data; ``"calibrated"``: the latter
        only; ``"raw"``: counts; ``"as set"``: its present setting. An MT9-B sends raw counts always.
    rate_hz : float, optional
        Samples per second; by default as set, and 100 for an MTData2 sensor whose content is chosen here.
    baud : int, optional
        Speed of the line; by default the common ones are tried.

    Raises
    ------
    InvalidInputError
        If the content is not known or the rate not from 1 to 2000 Hz.
    """

    content: str = "orientation"
    rate_hz: float | None = None
    baud: int | None = None

    def __post_init__(self) -> None:
        if self.content not in _CONTENTS:
            raise InvalidInputError(f"content: expected one of {', '.join(_CONTENTS)}, got {self.content!r}")
        if self.rate_hz is not None and not 1.0 <= self.rate_hz <= 2000.0:
            raise InvalidInputError(f"rate_hz: expected 1 to 2000, got {self.rate_hz:g}")


class DeviceInfo(NamedTuple):
    """Serial number, and the messages that a reader of the data needs before them."""

    device_id: int
    header: tuple[Message, ...]


class Device:
    """A sensor on an open port, which answers requests and sends data.

    Whatever it is asked for, it raises `DeviceError` if the port is gone. `tap` is called with all bytes that
    arrive, before they are decoded.
    """

    def __init__(self, port: Serial) -> None:
        self._port = port
        self._framer = Framer()
        self.tap: Callable[[bytes], None] | None = None
        self.close = port.close
        self.baud = int(port.baudrate)

    def receive(self) -> list[Message]:
        """Messages that arrive within a twentieth of a second."""
        with self._on_port():
            data = self._port.read(max(1, self._port.in_waiting))
        if data and self.tap is not None:
            self.tap(data)
        return self._framer.feed(data) if data else []

    def send(self, message: Message) -> None:
        """Send without waiting for an answer."""
        with self._on_port():
            self._port.write(encode(message))

    @contextmanager
    def _on_port(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # pyserial's own errors are OSErrors
            raise DeviceError(f"{self._port.name}: the port is gone: {error}") from error

    def request(self, mid: int, payload: bytes = b"", tries: int = _TRIES) -> Message:
        """Answer to a request; `DeviceError` if there is none after `tries`, or it is an error."""
        self.receive()  # a late answer to an earlier request is not one to this
        for _ in range(tries):
            self.send(Message(mid, payload))
            deadline = time.monotonic() + ANSWER_S
            while time.monotonic() < deadline:
                for message in self.receive():
                    if message.mid == mid + 1:
                        return message
                    if message.mid == MessageId.ERROR:
                        code = message.payload[:1].hex() or "none"
                        raise DeviceError(
                            f"{self._port.name}: message {mid:#04x}: error {code} of the sensor"
                        )
                    if message.mid == MessageId.WAKE_UP and mid != MessageId.GO_TO_CONFIG:
                        self.send(Message(MessageId.WAKE_UP_ACK))  # not to begin measuring
        raise DeviceError(
            f"{self._port.name}: expected an answer to message {mid:#04x}, got none in {tries} "
            f"tries of {ANSWER_S:g} s at {self.baud} baud"
        )

    def ask(self, mid: int) -> Message | None:
        """Answer to a request without payload; None if this sensor does not answer it."""
        try:
            return self.request(mid, tries=2)
        except DeviceError:
            return None


def connect(port_name: str, baud: int | None = None) -> Device:
    """Open a port with a sensor on it and bring the sensor to take settings.

    Raises
    ------
    FileError
        If the port cannot be opened, no sensor answers at `baud` (by default, at any of the common rates), or
        pyserial is not installed.
    """
    serial = extra_module("serial", "live", "a live sensor")
    rates = COMMON_BAUD if baud is None else (baud,)
    for rate in rates:
        try:  # for this process alone: 8 data bits, no parity, 2 stop bits
            port = serial.Serial(
                port_name,
                rate,
                stopbits=serial.STOPBITS_TWO,
                timeout=_POLL_S,
                write_timeout=ANSWER_S,
                exclusive=True,
            )
        except (OSError, ValueError) as error:
            raise DeviceError(f"{port_name}: cannot be opened as a serial port: {error}") from error
        device = Device(port)
        try:
            device.request(MessageId.GO_TO_CONFIG, tries=2 if baud is None else _TRIES)
            return device
        except DeviceError:
            device.close()
    raise DeviceError(f"{port_name}: expected a sensor, got no answer at {', '.join(map(str, rates))} baud")


def prepare(device: Device, settings: DeviceSettings) -> DeviceInfo:
    """Configure a sensor that takes settings, and ask it for what a reader of its data needs.

    Raises
    ------
    DeviceError
        If the sensor does not answer, or refuses a setting.
    InvalidInputError
        If its configuration is not as documented.
    """
    number = int.from_bytes(device.request(MessageId.REQ_DID).payload[:4], "big")
    outputs = device.ask(MessageId.OUTPUT_CONFIGURATION)
    mode, items = _CONTENTS[settings.content]
    if outputs is None:
        configuration = device.ask(MessageId.REQ_CONFIGURATION)
        units = () if configuration is None else Configuration.from_message(configuration).units
        mt9 = not units or units[0][0] & OutputMode.MT9  # which sends raw counts always
        if not mt9 and settings.content != "as set":
            device.request(MessageId.OUTPUT_MODE, mode.to_bytes(2, "big"))
            device.request(MessageId.OUTPUT_SETTINGS, OutputSettings.COUNTER.to_bytes(4, "big"))
            device.request(MessageId.SKIP_FACTOR, bytes(2))
        if settings.rate_hz is not None:
            device.request(MessageId.PERIOD, round(BASE_RATE_HZ / settings.rate_hz).to_bytes(2, "big"))
    elif items:
        rate = round(settings.rate_hz or 100.0)
        requests = [(_COUNTER, _EVERY), (_TIME, _EVERY), *((item, rate) for item in items), (_STATUS, _EVERY)]
        payload = b"".join(struct.pack(">HH", *request) for request in requests)
        outputs = device.request(MessageId.OUTPUT_CONFIGURATION, payload)
    answers = (device.ask(MessageId.REQ_CONFIGURATION), device.ask(MessageId.REQ_EMTS), outputs)
    return DeviceInfo(number, tuple(filter(None, answers)))
