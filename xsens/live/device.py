"""Find, configure, start and stop a live sensor on a serial port.

The sensor is in one of two states: in one it takes settings, in the other it sends data. It is always brought
to take settings first; data that arrive meanwhile are ignored.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from speckle3d.core.errors import FileError, InvalidInputError
from xsens.messages.control import (
    BASE_RATE_HZ,
    Configuration,
    MessageId,
    OutputItem,
    device_id,
    error_of,
    output_configuration,
    set_output_configuration,
)
from xsens.messages.framing import Framer, Message, encode
from xsens.messages.mtdata import OutputMode, OutputSettings
from xsens.messages.rawcounts import RawCalibration

if TYPE_CHECKING:
    from serial import Serial

Content = Literal["as set", "raw", "calibrated", "orientation"]

CONTENTS: tuple[Content, ...] = get_args(Content)

COMMON_BAUD = (115200, 921600, 460800, 230400, 57600)
"""Order in which rates are tried: the factory setting, then faster ones, which are set more often."""

ANSWER_S = 0.5
"""Time for an answer: a sensor takes a few milliseconds, an adapter's driver may add 16."""

_POLL_S = 0.05
_TRIES = 3
_EVERY = 0xFFFF

_MODES = {
    "raw": OutputMode.RAW,
    "calibrated": OutputMode.CALIBRATED,
    "orientation": OutputMode.CALIBRATED | OutputMode.ORIENTATION,
}
_CALIBRATED_ITEMS = (0x4020, 0x8020, 0xC020)
_ITEMS = {
    "raw": (0xA010,),
    "calibrated": _CALIBRATED_ITEMS,
    "orientation": (0x2010, *_CALIBRATED_ITEMS),
}
_STAMPS = (OutputItem(0x1020, _EVERY), OutputItem(0x1060, _EVERY))
_STATUS = OutputItem(0xE020, _EVERY)


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

    content: Content = "orientation"
    rate_hz: float | None = None
    baud: int | None = None

    def __post_init__(self) -> None:
        if self.content not in CONTENTS:
            raise InvalidInputError(f"content: expected one of {', '.join(CONTENTS)}, got {self.content!r}")
        if self.rate_hz is not None and not 1.0 <= self.rate_hz <= 2000.0:
            raise InvalidInputError(f"rate_hz: expected 1 to 2000, got {self.rate_hz:g}")


@dataclass(frozen=True)
class DeviceInfo:
    """Identity and settings that the sensor reports after it has been configured.

    Attributes
    ----------
    device_id : int
    kind : str
        ``"MT9-B"``, ``"legacy"`` (MTData) or ``"MTData2"``.
    rate_hz : float
        Samples per second; NaN if it does not report them.
    header : tuple of Message
        Configuration and calibration as the sensor sent them; a reader of its data needs them.
    """

    device_id: int
    kind: str
    rate_hz: float
    header: tuple[Message, ...]


class Device:
    """A sensor on an open port, which answers requests and sends data.

    Parameters
    ----------
    port : serial.Serial
        Open; closed with the device.

    Attributes
    ----------
    tap : callable, optional
        Called with all bytes that arrive, before they are decoded.
    """

    def __init__(self, port: Serial) -> None:
        self._port = port
        self._framer = Framer()
        self.tap: Callable[[bytes], None] | None = None

    @property
    def baud(self) -> int:
        """Speed of the line."""
        return int(self._port.baudrate)

    def close(self) -> None:
        """Close the port; the sensor's state does not change."""
        self._port.close()

    def receive(self) -> list[Message]:
        """Messages that arrive within a twentieth of a second.

        Raises
        ------
        DeviceError
            If the port is gone.
        """
        with self._there():
            data = self._port.read(max(1, self._port.in_waiting))
        if data and self.tap is not None:
            self.tap(data)
        return self._framer.feed(data) if data else []

    def send(self, message: Message) -> None:
        """Send without waiting for an answer."""
        with self._there():
            self._port.write(encode(message))

    def _waiting(self) -> bool:
        with self._there():
            return bool(self._port.in_waiting)

    @contextmanager
    def _there(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # pyserial's own errors are OSErrors
            reason = str(error).splitlines()[0]
            raise DeviceError(f"{self._port.name}: the port is gone: {reason}") from error

    def request(self, request: Message, tries: int = _TRIES) -> Message:
        """Send a request and wait for the answer; other messages that arrive meanwhile are ignored.

        Raises
        ------
        DeviceError
            If there is no answer after `tries`, or the answer is an error.
        """
        while self._waiting():  # a late answer to an earlier request is not one to this
            self.receive()
        for _ in range(tries):
            self.send(request)
            deadline = time.monotonic() + ANSWER_S
            while time.monotonic() < deadline:
                for message in self.receive():
                    if message.mid == request.mid + 1:
                        return message
                    self._refuse(message, request)
        raise DeviceError(
            f"{self._port.name}: expected an answer to message {request.mid:#04x}, got none in {tries} "
            f"tries of {ANSWER_S:g} s at {self._port.baudrate} baud"
        )

    def _refuse(self, message: Message, request: Message) -> None:
        """Raise at an error; tell a sensor that wakes up not to begin measuring."""
        if message.mid == MessageId.ERROR:
            raise DeviceError(
                f"{self._port.name}: message {request.mid:#04x} was answered by {error_of(message)}"
            )
        if message.mid == MessageId.WAKE_UP and request.mid != MessageId.GO_TO_CONFIG:
            self.send(Message(MessageId.WAKE_UP_ACK))

    def ask(self, mid: int) -> Message | None:
        """Answer to a request without payload; None if this sensor does not answer it."""
        try:
            return self.request(Message(mid), tries=2)
        except DeviceError:
            return None

    def go_to_config(self, tries: int = _TRIES) -> None:
        """Bring the sensor to take settings; it stops sending data."""
        self.request(Message(MessageId.GO_TO_CONFIG), tries)


def connect(port_name: str, baud: int | None = None) -> Device:
    """Open a port with a sensor on it and bring the sensor to take settings.

    Raises
    ------
    DeviceError
        If the port cannot be opened, or no sensor answers at `baud`, or at any of the common rates.
    FileError
        If pyserial is not installed.
    """
    rates = COMMON_BAUD if baud is None else (baud,)
    for rate in rates:
        device = Device(open_port(port_name, rate))
        with ExitStack() as undo:
            undo.callback(device.close)
            with suppress(DeviceError):
                device.go_to_config(tries=2 if baud is None else _TRIES)
                undo.pop_all()
                return device
    tried = ", ".join(str(rate) for rate in rates)
    raise DeviceError(f"{port_name}: expected a sensor, got no answer at {tried} baud")


def open_port(port_name: str, baud: int) -> Serial:
    """Open a serial port for this process alone: 8 data bits, no parity, 2 stop bits.

    Raises
    ------
    DeviceError
        If the port cannot be opened.
    FileError
        If pyserial is not installed.
    """
    try:
        import serial
    except ImportError as error:
        raise FileError("a live sensor needs pyserial: pip install 'speckle3d[live]'") from error
    try:
        return serial.Serial(
            port_name,
            baud,
            stopbits=serial.STOPBITS_TWO,
            timeout=_POLL_S,
            write_timeout=ANSWER_S,
            exclusive=True,
        )
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise DeviceError(f"{port_name}: cannot be opened as a serial port: {reason}") from error


def prepare(device: Device, settings: DeviceSettings) -> DeviceInfo:
    """Configure a sensor that takes settings, and ask it for what a reader of its data needs.

    Raises
    ------
    DeviceError
        If the sensor does not answer, or refuses a setting.
    """
    number = device_id(device.request(Message(MessageId.REQ_DID)))
    current = device.ask(MessageId.OUTPUT_CONFIGURATION)
    if current is not None:
        return _prepare_mtdata2(device, settings, number, current)
    before = device.ask(MessageId.REQ_CONFIGURATION)
    units = () if before is None else Configuration.from_message(before).units
    mt9 = not units or bool(units[0].output_mode & OutputMode.MT9)
    _configure_legacy(device, settings, mt9)
    return _describe(device, number, "MT9-B" if mt9 else "legacy")


def _describe(device: Device, number: int, kind: str) -> DeviceInfo:
    asked = (device.ask(MessageId.REQ_CONFIGURATION), device.ask(MessageId.REQ_EMTS))
    header = tuple(message for message in asked if message is not None)
    return DeviceInfo(number, kind, _rate_hz(header), header)


def _rate_hz(header: tuple[Message, ...]) -> float:
    """Rate by the configuration, else by the calibration block; NaN if neither holds it."""
    for message in header:
        if message.mid == MessageId.CONFIGURATION:
            return Configuration.from_message(message).rate_hz
        with suppress(InvalidInputError):  # later sensors' blocks have another layout
            return RawCalibration.from_message(message).rate_hz
    return float("nan")


def _configure_legacy(device: Device, settings: DeviceSettings, mt9: bool) -> None:
    if not mt9 and settings.content != "as set":
        _set(device, MessageId.OUTPUT_MODE, _MODES[settings.content], 2)
        _set(device, MessageId.OUTPUT_SETTINGS, OutputSettings.COUNTER, 4)
        _set(device, MessageId.SKIP_FACTOR, 0, 2)
    if settings.rate_hz is not None:
        _set(device, MessageId.PERIOD, round(BASE_RATE_HZ / settings.rate_hz), 2)


def _set(device: Device, mid: MessageId, value: int, size: int) -> None:
    device.request(Message(mid, int(value).to_bytes(size, "big")))


def _prepare_mtdata2(device: Device, settings: DeviceSettings, number: int, current: Message) -> DeviceInfo:
    answer = current
    if settings.content != "as set":
        rate = round(settings.rate_hz or 100.0)
        items = tuple(OutputItem(identifier, rate) for identifier in _ITEMS[settings.content])
        answer = device.request(set_output_configuration((*_STAMPS, *items, _STATUS)))
    rates = [item.rate_hz for item in output_configuration(answer) if item.rate_hz not in (0, _EVERY)]
    info = _describe(device, number, "MTData2")
    rate_hz = float(max(rates)) if rates else info.rate_hz
    return DeviceInfo(number, "MTData2", rate_hz, (*info.header, answer))
