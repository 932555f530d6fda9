"""Record a live sensor to a file that survives a crash, unplugging and plugging in again.

Bytes are appended to the file as they arrive, before they are decoded: ending the program in any way loses
only what the sensor has not yet sent. The file holds the sensor's own messages. Each stretch of measuring
begins with its configuration, its calibration, and the time of the computer's clock (as a UTC message), by
which a reader can tell how long the sensor was disconnected.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress

from speckle3d.core.errors import FileError, InvalidInputError, naming
from speckle3d.core.files import PathLike, cannot_write
from xsens.live.device import Device, DeviceError, DeviceInfo, DeviceSettings, connect, prepare
from xsens.live.monitor import LiveState, Monitor, warm_up
from xsens.messages.control import MessageId, utc_message
from xsens.messages.framing import encode

_INTERVAL_S = 0.25
"""Time between two states that `record` yields."""

SILENCE_S = 2.0
"""A sensor silent for so long is taken for disconnected and asked to answer; its slowest rate is 1 Hz."""

RETRY_S = 0.1
"""Pause between two searches for a sensor: after power-up it waits only half a second for settings."""


class RawFile:
    """A file to which bytes are appended, each piece handed to the operating system at once.

    Raises `FileError` if the file exists, unless told to `append`, or it cannot be written.
    """

    def __init__(self, path: PathLike, append: bool = False) -> None:
        self.path = path
        try:
            self._file = open(path, "ab" if append else "xb", buffering=0)  # noqa: SIM115
        except FileExistsError as error:
            raise FileError(f"{path}: there already; expected a new file, or to be told to append") from error
        except OSError as error:
            raise cannot_write(path, error) from error

    def append(self, data: bytes) -> None:
        """Append bytes; the operating system has all of them when this returns."""
        left = memoryview(data)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def sync(self) -> None:
        """Write to the disk, so that the bytes survive a power failure, not only one of the program."""
        with suppress(OSError, ValueError):  # pipes and some network file systems cannot, nor a closed file
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Write everything to the disk and close; closing twice does nothing."""
        self.sync()
        self._file.close()


class Recorder:
    """Record a sensor in a thread of its own, so that a slow display loses no bytes.

    Parameters
    ----------
    port : str
        Name of the serial port.
    path : path
        New file, or an existing one to continue if `append`.
    settings : DeviceSettings, optional
    append : bool

    Raises
    ------
    FileError
        If no sensor answers or it refuses its settings (a DeviceError), or the file cannot be written.
    """

    def __init__(
        self, port: str, path: PathLike, settings: DeviceSettings | None = None, append: bool = False
    ) -> None:
        self._port, self._settings = port, settings or DeviceSettings()
        self._baud, self._info = self._settings.baud, DeviceInfo(-1, ())
        warm_up()
        device = self._prepare()
        try:
            self._file = RawFile(path, append)
        except FileError:
            device.close()
            raise
        self._monitor = Monitor()
        self._failure: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._record, args=(device,), daemon=True)
        self._thread.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the sensor, record what it sends until then, and close port and file."""
        self._stop.set()
        self._thread.join()
        self._file.close()

    def state(self) -> LiveState:
        """State, after writing all to the disk; raises what has ended the recording, as a full disk does."""
        if self._failure is not None:
            raise self._failure
        self._file.sync()
        return self._monitor.state()

    def _prepare(self) -> Device:
        """The sensor, ready to measure; always the same one."""
        with naming(self._port), ExitStack() as undo:
            device = connect(self._port, self._baud)
            undo.callback(device.close)
            info, before = prepare(device, self._settings), self._info.device_id
            if before not in (-1, info.device_id):
                raise DeviceError(f"{self._port}: expected sensor {before:08X}, got {info.device_id:08X}")
            self._baud, self._info = device.baud, info
            undo.pop_all()
        return device

    def _record(self, device: Device | None) -> None:
        """Run in the thread: measure, and find the sensor again when it is lost, until told to stop."""
        try:
            while not self._stop.is_set():
                try:
                    with closing(device or self._prepare()) as device:
                        self._measure(device)
                except (DeviceError, InvalidInputError) as error:  # and no others: a full disk stays full
                    self._monitor.take(str(error))
                    device = None
                    self._stop.wait(RETRY_S)
        except Exception as error:  # noqa: BLE001 (raised by `state`)
            self._failure = error

    def _measure(self, device: Device) -> None:
        self._file.append(b"".join(map(encode, (*self._info.header, utc_message()))))
        self._monitor.take(self._info.header)
        device.tap = self._take
        device.request(MessageId.GO_TO_MEASUREMENT)
        heard = time.monotonic()
        while not self._stop.is_set():
            now = time.monotonic()  # before reading: to wait for other threads is no silence
            messages = device.receive()
            if messages:
                heard = now
            if any(message.mid == MessageId.WAKE_UP for message in messages):
                raise DeviceError(f"{self._port}: the sensor had no power for a moment")
            if now - heard > SILENCE_S:
                raise DeviceError(f"{self._port}: the sensor has been silent for {SILENCE_S:g} s")
        with suppress(DeviceError):  # what it sends until it stops is recorded as well
            device.request(MessageId.GO_TO_CONFIG)

    def _take(self, data: bytes) -> None:
        self._file.append(data)
        self._monitor.take(data)


def record(
    port: str,
    path: PathLike,
    settings: DeviceSettings | None = None,
    append: bool = False,
    duration_s: float = math.inf,
) -> Iterator[LiveState]:
    """Record a sensor and yield its state, until the time is over or the iteration is left.

    Parameters
    ----------
    port, path, settings, append
        As for `Recorder`.
    duration_s : float
        Length of the recording.

    Yields
    ------
    LiveState
        The last one when the whole recording is in the file.
    """
    with Recorder(port, path, settings, append) as recorder:
        end = time.monotonic() + duration_s
        while (left := end - time.monotonic()) > 0:
            time.sleep(min(_INTERVAL_S, left))
            yield recorder.state()
    yield recorder.state()
