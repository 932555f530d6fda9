"""State of a live sensor from its own messages: rate, losses, orientation, and magnetic disturbance."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError, Speckle3DError
from xsens.live.device import DeviceInfo
from xsens.logs.parts import Hints
from xsens.logs.read import parse_stream
from xsens.logs.samples import ImuLog
from xsens.messages.control import MessageId
from xsens.messages.framing import Framer, encode

if TYPE_CHECKING:
    from xsens.fusion.online import OnlineFilter

RATE_OVER_S = 2.0
"""Long against the 16 ms between two deliveries of an adapter, short enough for a display."""

NORM_TOLERANCE, DIP_TOLERANCE_RAD = 0.1, np.deg2rad(10.0)
"""A field that differs by more from the first second's is disturbed; defaults of VQF (Laidig and Seel,
Information Fusion 91, 2023)."""

REFERENCE_S = 1.0
"""Time at the start over which the reference field is averaged."""

_WORD = 1 << 16
_MOST_PENDING = 1 << 20
_MOST_ARRIVALS = 1 << 12
_DATA = (MessageId.MT_DATA, MessageId.MT_DATA2)


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
        Samples received per second over the last two seconds.
    bytes_written : int
    world_from_sensor : Rotation, optional
        The sensor's own orientation, or the on-line filter's.
    field : float
        Norm of the magnetic field over that at the start; NaN without a magnetometer.
    dip_change_rad : float
        Change of the field's angle to the vertical; NaN without a magnetometer.
    note : str
        The last problem; empty if there was none.
    """

    connected: bool
    elapsed_s: float
    samples: int
    lost: int
    interruptions: int
    rate_hz: float
    bytes_written: int
    world_from_sensor: Rotation | None
    field: float
    dip_change_rad: float
    note: str

    @property
    def disturbed(self) -> bool | None:
        """Whether the field differs from that at the start; None if there is none."""
        if not np.isfinite(self.field):
            return None
        norm_off = abs(self.field - 1.0) > NORM_TOLERANCE
        return bool(norm_off or abs(self.dip_change_rad) > DIP_TOLERANCE_RAD)

    def line(self) -> str:
        """The state in one line of text."""
        parts = [f"{self.elapsed_s:6.1f} s", f"{self.samples} samples", f"{self.lost} lost"]
        parts.append(f"{self.rate_hz:.1f} Hz" if self.connected else "NOT CONNECTED")
        if self.interruptions:
            parts.append(f"{self.interruptions} interruptions")
        if self.world_from_sensor is not None:
            yaw, pitch, roll = self.world_from_sensor.as_euler("ZYX", degrees=True)
            parts.append(f"roll {roll:+.1f} pitch {pitch:+.1f} yaw {yaw:+.1f}")
        if self.disturbed is not None:
            verdict = "DISTURBED" if self.disturbed else "clear"
            parts.append(f"field {self.field:.2f} dip {np.rad2deg(self.dip_change_rad):+.0f} {verdict}")
        if self.note and not self.connected:
            parts.append(self.note)
        return " | ".join(parts)


class Monitor:
    """Count what a recording thread receives; decode it when asked for the state."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._since_s = time.monotonic()
        self._connected = False
        self._samples = self._lost = self._interruptions = 0
        self._note = ""
        self._arrivals: deque[tuple[float, int]] = deque(maxlen=_MOST_ARRIVALS)
        self._framer = Framer()
        self._header, self._hints, self._pending = b"", Hints(as_stated=True), bytearray()
        self._counter: int | None = None
        self._attitude = _Attitude()
        self._field = _Field()

    def started(self, info: DeviceInfo) -> None:
        """Note that the sensor begins to measure; its counter may start anywhere."""
        with self._lock:
            self._digest()
            self._header = b"".join(encode(message) for message in info.header)
            self._hints = Hints(rate_hz=info.rate_hz if info.rate_hz > 0 else None, as_stated=True)
            self._connected, self._counter = True, None
            self._framer = Framer()
            self._arrivals.clear()
            self._attitude = _Attitude(info.rate_hz)

    def arrived(self, received: bytes) -> None:
        """Take in received bytes, in pieces of any size."""
        with self._lock:
            now_s = time.monotonic()
            data = [message for message in self._framer.feed(received) if message.mid in _DATA]
            self._samples += len(data)
            self._arrivals.append((now_s, len(data)))
            self._pending += b"".join(map(encode, data))
            if len(self._pending) > _MOST_PENDING:  # nobody has asked for a while
                self._digest()

    def interrupted(self, reason: str) -> None:
        """Note that the connection is lost, or still is."""
        with self._lock:
            self._digest()
            self._interruptions += self._connected
            self._connected, self._note = False, reason

    def state(self, bytes_written: int) -> LiveState:
        """The state now, given the size of the file."""
        with self._lock:
            self._digest()
            return LiveState(
                connected=self._connected,
                elapsed_s=time.monotonic() - self._since_s,
                samples=self._samples,
                lost=self._lost,
                interruptions=self._interruptions,
                rate_hz=self._rate_hz(),
                bytes_written=bytes_written,
                world_from_sensor=self._attitude.latest if self._connected else None,
                field=self._field.ratio,
                dip_change_rad=self._field.dip_change_rad,
                note=self._note,
            )

    def _rate_hz(self) -> float:
        """Samples after the oldest arrival that is kept, over the time since it."""
        while len(self._arrivals) > 2 and self._arrivals[-1][0] - self._arrivals[0][0] > RATE_OVER_S:
            self._arrivals.popleft()
        if not self._connected or len(self._arrivals) < 2:
            return 0.0
        span_s = max(time.monotonic(), self._arrivals[-1][0]) - self._arrivals[0][0]
        return sum(count for _, count in list(self._arrivals)[1:]) / span_s

    def _digest(self) -> None:
        data, self._pending = bytes(self._pending), bytearray()
        if not data:
            return
        try:
            log = parse_stream(self._header + data, self._hints)
        except Speckle3DError as error:
            self._note = str(error)
            return
        rotations = self._attitude.follow(log, self._count_lost(log))
        self._field.follow(log, rotations)

    def _count_lost(self, log: ImuLog) -> int:
        """Count the samples missing within the log and before it; return the latter."""
        self._lost += log.lost
        if log.counter is None:
            return 0
        before = 0
        if self._counter is not None:
            before = int(log.counter[0] - self._counter - 1) % _WORD
            self._lost += before
        self._counter = int(log.counter[-1]) % _WORD
        return before


def _fresh_filter() -> OnlineFilter:
    from xsens.fusion.online import OnlineFilter  # which loads numba

    return OnlineFilter()


class _Attitude:
    """Latest orientation: the sensor's own if it sends one, else the filter's."""

    def __init__(self, rate_hz: float = float("nan")) -> None:
        self.latest: Rotation | None = None
        self._filter = _fresh_filter()
        self._step_s = 1.0 / rate_hz if rate_hz > 0 else float("nan")

    def follow(self, log: ImuLog, lost_before: int) -> Rotation | None:
        """Take in some samples; return the orientation of each if the sensor sent all of them."""
        if log.world_from_sensor is None or not log.oriented.any():
            self._filtered(log, lost_before)
            return None
        self.latest = log.world_from_sensor[log.oriented][-1]
        return log.world_from_sensor if log.oriented.all() else None

    def _filtered(self, log: ImuLog, lost_before: int) -> None:
        if log.gyroscope_rad_s is None or log.accelerometer_m_s2 is None:
            self.latest = None
            return
        steps = np.diff(log.time_s)
        if steps.size:
            self._step_s = float(np.median(steps))
        if not np.isfinite(self._step_s):
            return
        first = self._step_s * (1 + lost_before)
        try:
            self._filter.push(
                [first, *steps], log.gyroscope_rad_s, log.accelerometer_m_s2, log.magnetometer_au
            )
        except InvalidInputError:  # damaged readings: the recording keeps them, the displayed filter restarts
            self._filter = _fresh_filter()
        state = self._filter.state
        self.latest = None if state is None else state.world_from_sensor


class _Field:
    """Norm of the magnetic field and its angle to the vertical, compared with those of the first second."""

    def __init__(self) -> None:
        self.ratio = self.dip_change_rad = float("nan")
        self._learnt_s = 0.0
        self._sum = np.zeros(3)

    def follow(self, log: ImuLog, rotations: Rotation | None) -> None:
        """Take in some samples."""
        up = log.accelerometer_m_s2 if rotations is None else rotations.inv().apply([0.0, 0.0, 1.0])
        if log.magnetometer_au is None or up is None:
            return
        norm, length = np.linalg.norm(log.magnetometer_au, axis=1), np.linalg.norm(up, axis=1)
        there = (norm > 0) & (length > 0)  # NaN is not
        if not there.any():
            return
        sine = np.einsum("ij,ij->i", log.magnetometer_au[there], up[there]) / (norm * length)[there]
        norm, dip = norm[there], -np.arcsin(np.clip(sine, -1.0, 1.0))
        if self._learnt_s < REFERENCE_S:
            self._learnt_s += norm.size / log.rate_hz if len(log) > 1 else 0.0
            self._sum += [norm.sum(), dip.sum(), norm.size]
        usual_norm, usual_dip = self._sum[:2] / self._sum[2]
        self.ratio = float(norm.mean() / usual_norm)
        self.dip_change_rad = float(dip.mean() - usual_dip)
