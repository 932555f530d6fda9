"""A sensor on a pseudo-terminal that speaks the vendor's protocol, written from its description alone.

It shares no code with the package: what it sends is packed here, byte by byte. It can be unplugged and
plugged in again, as another terminal behind the same path.
"""

import contextlib
import math
import os
import select
import struct
import threading
import time
import tty

import pytest

OFF, ASLEEP, CONFIGURATION, MEASUREMENT = "off", "asleep", "configuration", "measurement"

KINDS = ("mt9", "legacy", "mtdata2")

G = 9.81
OFFSETS = (29232, 33453, 31626, 32611, 32545, 32542, 30349, 33547, 33016)
GAINS = (1268.25, 1269.5, 1287.25, 1249.75, 1273.0, 1249.25, 8825.25, 7365.5, 7753.25)
"""Of the accelerometer, gyroscope and magnetometer of a real unit, rounded to what its block can hold."""

FIELD = (0.44, 0.0, -0.9)
"""North, west, up; of norm 1 and dip 64 degrees."""

DEVICE_ID = 0x00030A5C


def frame(mid, payload=b""):
    body = bytes([0xFF, mid]) + (
        bytes([len(payload)]) if len(payload) < 255 else b"\xff" + struct.pack(">H", len(payload))
    )
    body += payload
    return b"\xfa" + body + bytes([-sum(body) & 0xFF])


def heading_rad(index, rate_hz):
    """It turns about the vertical, ten degrees per second."""
    return math.radians(10.0) * index / rate_hz


def values(index, rate_hz, iron=0.0):
    """Accelerometer, gyroscope, magnetometer, and quaternion of a level sensor that turns."""
    psi = heading_rad(index, rate_hz)
    north, west, up = FIELD[0] + iron, FIELD[1], FIELD[2]
    c, s = math.cos(psi), math.sin(psi)
    field = (c * north + s * west, -s * north + c * west, up)
    return (
        (0.0, 0.0, G),
        (0.0, 0.0, math.radians(10.0)),
        field,
        (math.cos(psi / 2), 0.0, 0.0, math.sin(psi / 2)),
    )


def of_kind(*kinds, **options):
    """Run a test that takes `sensor` with each of some kinds."""
    return pytest.mark.parametrize(
        "sensor", [{"kind": kind, **options} for kind in kinds], indirect=True, ids=kinds
    )


def wait_until(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


class SimulatedDevice:
    """A sensor with power, and a cable to a path that can be opened as a serial port.

    Parameters
    ----------
    path : pathlib.Path
        A symbolic link to the terminal, as ``/dev/serial/by-id`` has; it disappears with the plug.
    """

    def __init__(self, path, kind="mt9", rate_hz=200.0):
        self.path, self.kind, self.wake_s = path, kind, 0.5
        self.rate_hz = rate_hz
        self.mode = {"mt9": 0x8000, "legacy": 0x0004}.get(kind, 0)
        self.settings, self.skip, self.outputs = 0, 0, ((0x2010, 50),)
        self.iron = 0.0
        self.runs: list[list[int]] = []
        self._master = self._slave = None
        self._paused = threading.Event()
        self._quiet = threading.Event()
        self._stop = threading.Event()
        self._lock = threading.RLock()
        self.state = OFF
        self.plug()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join(5)
        self._pull()

    @property
    def run(self):
        """Counters of the samples sent since it last began to measure."""
        return self.runs[-1] if self.runs else []

    # what a person can do

    def plug(self):
        with self._lock:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            with contextlib.suppress(FileNotFoundError):
                self.path.unlink()
            self.state, self._woken_at, self._said = ASLEEP, time.monotonic(), False
            self._buffer, self._next = b"", 0
            self.path.symlink_to(os.ttyname(self._slave))

    def unplug(self):
        """Pull the plug when all that was sent has arrived; the power goes with it."""
        self.settle()
        with self._lock:
            self._pull()
            self.state = OFF
        self._paused.clear()

    def _pull(self):
        if self._master is not None:
            os.close(self._master)
            os.close(self._slave)
            self.path.unlink(missing_ok=True)
        self._master = self._slave = None

    def settle(self):
        """Stop sampling, and wait until the other side has taken all that was sent."""
        self._paused.set()
        self._quiet.wait(1.0)
        time.sleep(0.15)

    def resume(self):
        self._paused.clear()

    # what it does

    def _run(self):
        while not self._stop.is_set():
            with self._lock:
                if self._master is None:
                    pause = 0.01
                else:
                    self._listen()
                    self._wake()
                    pause = self._sample()
            time.sleep(pause)

    def _wake(self):
        if self.state == ASLEEP and not self._said:
            self._said = True
            self._write(frame(0x3E, struct.pack(">I", DEVICE_ID)))
        if self.state == ASLEEP and time.monotonic() - self._woken_at > self.wake_s:
            self._measure()

    def _measure(self):
        self.state = MEASUREMENT
        self._started, self._first = time.monotonic(), self._next
        self.runs.append([])

    def _sample(self):
        """Send what is due; the number of seconds until the next sample."""
        if self._paused.is_set():
            self._quiet.set()
            if self.state == MEASUREMENT:  # time stands still too, so that no sample is skipped
                self._started = time.monotonic() - (self._next - self._first) / self.rate_hz
            return 0.002
        self._quiet.clear()
        while self.state == MEASUREMENT:
            due = self._started + (self._next - self._first) / self.rate_hz
            early_s = due - time.monotonic()
            if early_s > 0:
                return min(early_s, 0.005)
            self._send(self._next)
            self._next += 1
        return 0.002

    def _send(self, index):
        counter = index & 0xFFFF
        if self._write(self._data(index, counter)):
            self.runs[-1].append(counter)

    def _data(self, index, counter):
        acc, gyr, mag, q = values(index, self.rate_hz, self.iron)
        if self.kind == "mt9":
            counts = [round(b + g * v) for b, g, v in zip(OFFSETS, GAINS, (*acc, *gyr, *mag), strict=True)]
            return frame(0x32, struct.pack(">H9HH", counter, *counts, 32 * 256))
        if self.kind == "legacy":
            payload = b""
            if self.mode & 0x2:
                payload += struct.pack(">9f", *acc, *gyr, *mag)
            if self.mode & 0x4:
                payload += struct.pack(">4f", *q)
            return frame(0x32, payload + (struct.pack(">H", counter) if self.settings & 1 else b""))
        return frame(0x36, b"".join(self._item(identifier, index, counter) for identifier, _ in self.outputs))

    def _item(self, identifier, index, counter):
        acc, gyr, mag, q = values(index, self.rate_hz, self.iron)
        data = {
            0x1020: lambda: struct.pack(">H", counter),
            0x1060: lambda: struct.pack(">I", round(index * 1e4 / self.rate_hz) & 0xFFFFFFFF),
            0x2010: lambda: struct.pack(">4f", *q),
            0x4020: lambda: struct.pack(">3f", *acc),
            0x8020: lambda: struct.pack(">3f", *gyr),
            0xC020: lambda: struct.pack(">3f", *mag),
            0xE020: lambda: struct.pack(">I", 3),
        }[identifier]()
        return struct.pack(">HB", identifier, len(data)) + data

    def _write(self, data):
        try:
            return os.write(self._master, data) == len(data)
        except (BlockingIOError, OSError):
            return False  # nobody reads, or nobody is there

    # what it is told

    def _listen(self):
        readable, _, _ = select.select([self._master], [], [], 0)
        if not readable:
            return
        try:
            self._buffer += os.read(self._master, 4096)
        except OSError:
            return
        while len(self._buffer) >= 5:
            size = 5 + self._buffer[3]
            if self._buffer[0] != 0xFA or (len(self._buffer) >= size and sum(self._buffer[1:size]) & 0xFF):
                self._buffer = self._buffer[1:]
            elif len(self._buffer) < size:
                return
            else:
                message, self._buffer = self._buffer[:size], self._buffer[size:]
                self._obey(message[2], message[4:-1])

    def _obey(self, mid, payload):
        if mid == 0x30 or (mid == 0x3F and self.state == ASLEEP):
            self.state = CONFIGURATION
            if mid == 0x30:
                self._write(frame(0x31))
        elif self.state != CONFIGURATION:
            return
        elif mid == 0x10:
            self._write(frame(0x11))
            self._measure()
        else:
            answer = self._answer(mid, payload)
            self._write(frame(mid + 1, answer) if answer is not None else frame(0x42, b"\x04"))

    def _answer(self, mid, payload):
        legacy = self.kind == "legacy"
        if mid == 0x00:
            return struct.pack(">I", DEVICE_ID)
        if mid == 0x0C:
            return self._configuration()
        if mid == 0x04 and self.kind != "mtdata2":
            if payload:
                self.rate_hz = 115200 / struct.unpack(">H", payload)[0]
            return b""
        if mid == 0x90 and self.kind == "mt9":
            return self._calibration_block()
        if mid == 0xC0 and self.kind == "mtdata2":
            if payload:
                self.outputs = tuple(struct.iter_unpack(">HH", payload))
                self.rate_hz = float(max(rate for _, rate in self.outputs if rate != 0xFFFF))
            return b"".join(struct.pack(">HH", *item) for item in self.outputs)
        if mid == 0xD0 and legacy:
            self.mode = struct.unpack(">H", payload)[0]
            return b""
        if mid == 0xD2 and legacy:
            self.settings = struct.unpack(">I", payload)[0]
            return b""
        if mid == 0xD4 and legacy:
            self.skip = struct.unpack(">H", payload)[0]
            return b""
        return None

    def _configuration(self):
        block = bytearray(118)
        length = {"mt9": 22, "mtdata2": 0}.get(
            self.kind, 36 * bool(self.mode & 2) + 16 * bool(self.mode & 4) + 2
        )
        struct.pack_into(">IHH", block, 0, DEVICE_ID, round(115200 / self.rate_hz), self.skip)
        struct.pack_into(">HIHHI", block, 96, 1, DEVICE_ID, length, self.mode, self.settings)
        return bytes(block)

    def _calibration_block(self):
        block = bytearray(168)
        identity = (16384, 0, 0, 0, 16384, 0, 0, 0, 16384)
        struct.pack_into(">I", block, 0, DEVICE_ID)
        for at in (8, 26, 132, 150):
            struct.pack_into(">9h", block, at, *identity)
        struct.pack_into(">H", block, 81, round(115200 / self.rate_hz))
        struct.pack_into(">9H", block, 87, *OFFSETS)
        for i, gain in enumerate(GAINS):
            block[105 + 3 * i : 108 + 3 * i] = round(gain * 256).to_bytes(3, "big")
        return bytes(block)
