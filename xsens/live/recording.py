"""Record a live sensor to a file that survives a crash, unplugging and plugging in again.

Bytes are appended to the file as they arrive, before they are decoded: ending the program in any way loses
only what the sensor has not yet sent. The file holds the sensor's own messages. Each stretch of measuring
begins with its configuration, its calibration, and the time of the computer's clock (as a UTC message), by
which a reader can tell how long the sensor was disconnected.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import FileError, InvalidInputError, Speckle3DError, naming
from speckle3d.core.files import PathLike, cannot_write
from speckle3d.core.text import shown
from xsens.fusion.field import ROUGH, dip_rad
from xsens.live.device import Device, DeviceError, DeviceInfo, DeviceSettings, connect, prepare
from xsens.logs.assembly import Hints
from xsens.logs.datamessages import parse_stream
from xsens.logs.samples import ImuLog
from xsens.messages.contents import DATA, MessageId, utc_message
from xsens.messages.framing import Framer, Message, encode

if TYPE_CHECKING:
    from xsens.fusion.online import OnlineFilter, OnlineState

_INTERVAL_S = 0.25
"""Time between two states that `record` yields."""

SILENCE_S = 2.0
"""A sensor silent for so long is taken for disconnected and asked to answer; its slowest rate is 1 Hz."""

RETRY_S = 0.1
"""Pause between two searches for a sensor: after power-up it waits only half a second for settings."""


# -- its state


@shown
@dataclass(frozen=True)
class LiveState:
    """Present state of a sensor being recorded.

    Attributes
    ----------
    connected : bool
    elapsed_s : float
        Time since measuring began.
    samples, lost : int
        Samples received, and missing by the sensor's own counter while it was connected.
    interruptions : int
        How often the connection was lost.
    rate_hz : float
        Samples per second as the sensor takes them; 0 until two have come.
    world_from_sensor : Rotation, optional
        The sensor's own orientation, or the on-line filter's.
    field : float
        Norm of the magnetic field, the sensor's unit; NaN without a magnetometer.
    dip_rad : float
        Angle of the field below the horizontal; NaN without a magnetometer.
    note : str
        The last problem; empty if there was none.
    fused : OnlineState, optional
        What the on-line filter makes of the readings; None before it has begun, or without gyroscope or
        accelerometer.
    rate_rad_s : ndarray, shape (3,), optional
        The gyroscope's last reading.
    """

    connected: bool
    elapsed_s: float
    samples: int
    lost: int
    interruptions: int
    rate_hz: float
    world_from_sensor: Rotation | None
    field: float
    dip_rad: float
    note: str
    fused: OnlineState | None = None
    rate_rad_s: FloatArray | None = None

    @property
    def disturbed(self) -> bool | None:
        """Whether the filter does not trust the magnetic field; None until it knows, or without one."""
        fused = self.fused
        if fused is None or not fused.started or not np.isfinite(fused.field_stray):
            return None
        return fused.disturbed or fused.field_stray > ROUGH


class Monitor:
    """Gather what a recording thread receives; decode it when another thread asks for the state."""

    def __init__(self) -> None:
        self._since_s, self._events = time.monotonic(), deque[Any]()
        self._now = LiveState(False, 0.0, 0, 0, 0, 0.0, None, np.nan, np.nan, "")

    def take(self, event: bytes | tuple[Message, ...] | str) -> None:
        """Keep bytes as received, the header of a sensor that begins to measure, or why it is lost.

        An hour of them, for which nobody may ask, is some ten megabytes.
        """
        self._events.append(event)

    def state(self) -> LiveState:
        """The state now."""
        digest: dict[type, Any] = {bytes: self._digest, tuple: self._begin, str: self._interrupt}
        events = [self._events.popleft() for _ in range(len(self._events))]
        for kind, group in groupby(events, type):
            pieces = list(group)
            digest[kind](b"".join(pieces) if kind is bytes else pieces[-1])
        return replace(self._now, elapsed_s=time.monotonic() - self._since_s)

    def _set(self, **changes: Any) -> None:
        self._now = replace(self._now, **changes)

    def _begin(self, header: tuple[Message, ...]) -> None:
        """Begin to measure; the sensor's counter may start anywhere."""
        self._header, self._framer = b"".join(map(encode, header)), Framer()
        self._counter: int | None = None
        self._filter: OnlineFilter | None = None
        self._set(connected=True)

    def _interrupt(self, reason: str) -> None:
        """Note that the connection is lost, or still is."""
        count = self._now.interruptions + self._now.connected
        self._set(connected=False, interruptions=count, world_from_sensor=None, fused=None, note=reason)

    def _digest(self, data: bytes) -> None:
        """Decode bytes, of which a message's end may follow later."""
        messages = [message for message in self._framer.feed(data) if message.mid in DATA]
        if not messages:
            return
        self._set(samples=self._now.samples + len(messages))
        try:
            log = parse_stream(self._header + b"".join(map(encode, messages)), Hints(as_stated=True))
        except Speckle3DError as error:
            self._set(note=str(error))
            return
        missing = 0
        if log.counter is not None:
            if self._counter is not None:
                missing = int(log.counter[0] - self._counter - 1) % (1 << 16)
            self._counter = int(log.counter[-1])
        if len(log) > 1:
            self._set(rate_hz=log.rate_hz)
        fused = self._follow(log, missing)
        world_from_sensor = None if fused is None else fused.world_from_sensor
        if log.world_from_sensor is not None and log.oriented.any():
            world_from_sensor = log.world_from_sensor[log.oriented][-1]
        rates, field = log.gyroscope_rad_s, log.magnetometer_au
        if field is not None and np.isfinite(field[-1]).all():
            dip = np.nan if world_from_sensor is None else dip_rad(world_from_sensor.apply(field[-1:]))[0]
            self._set(field=float(np.linalg.norm(field[-1])), dip_rad=float(dip))
        self._set(
            lost=self._now.lost + log.lost + missing,
            world_from_sensor=world_from_sensor,
            fused=fused,
            rate_rad_s=None if rates is None else rates[-1],
        )

    def _follow(self, log: ImuLog, missing: int) -> OnlineState | None:
        """Filter some samples, with the number of those missing before them."""
        gyroscope, accelerometer = log.gyroscope_rad_s, log.accelerometer_m_s2
        if gyroscope is None or accelerometer is None or not self._now.rate_hz:
            return None
        steps = np.append((1 + missing) / self._now.rate_hz, np.diff(log.time_s))
        from xsens.fusion.online import OnlineFilter  # which loads numba

        self._filter = self._filter or OnlineFilter()
        try:
            self._filter.push(steps, gyroscope, accelerometer, log.magnetometer_au)
        except InvalidInputError:  # damaged readings: the recording keeps them, the displayed filter restarts
            self._filter = OnlineFilter()
        return self._filter.state


def warm_up() -> None:
    """Load the filter, or compile it, which would keep a recording from reading its port for too long."""
    from xsens.fusion.online import OnlineFilter

    readings = np.full((150, 3), 5.7)  # as long as gravity
    OnlineFilter().push(np.full(150, 0.01), readings, readings, readings)


# -- its bytes


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
    duration_s: float = np.inf,
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
