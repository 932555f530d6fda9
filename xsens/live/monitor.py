"""State of a live sensor from its own messages: rate, losses, orientation, and magnetic disturbance."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, replace
from itertools import groupby
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.text import shown
from xsens.fusion.field import ROUGH, dip_rad
from xsens.logs.assembly import Hints
from xsens.logs.datamessages import parse_stream
from xsens.logs.samples import ImuLog
from xsens.messages.control import DATA
from xsens.messages.framing import Framer, Message, encode

if TYPE_CHECKING:
    from speckle3d.core.arrays import FloatArray
    from xsens.fusion.online import OnlineFilter, OnlineState


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

    def line(self) -> str:
        """The state in one line of text."""
        parts = [f"{self.elapsed_s:6.1f} s", f"{self.samples} samples", f"{self.lost} lost"]
        parts.append(f"{self.rate_hz:.1f} Hz" if self.connected else "NOT CONNECTED")
        if self.interruptions:
            parts.append(f"{self.interruptions} interruptions")
        if self.world_from_sensor is not None:
            yaw, pitch, roll = self.world_from_sensor.as_euler("ZYX", degrees=True)
            parts.append(f"roll {roll:+.1f} pitch {pitch:+.1f} yaw {yaw:+.1f}")
        if np.isfinite(self.field):
            verdict = {None: "", True: " DISTURBED", False: " clear"}[self.disturbed]
            parts.append(f"field {self.field:.2f} dip {np.rad2deg(self.dip_rad):.0f}{verdict}")
        if self.note and not self.connected:
            parts.append(self.note)
        return " | ".join(parts)


class Monitor:
    """Gather what a recording thread receives; decode it when asked for the state."""

    def __init__(self) -> None:
        self._lock, self._since_s, self._events = Lock(), time.monotonic(), deque[Any]()
        self._now = LiveState(False, 0.0, 0, 0, 0, 0.0, None, np.nan, np.nan, "")

    def take(self, event: bytes | tuple[Message, ...] | str) -> None:
        """Keep bytes as received, the header of a sensor that begins to measure, or why it is lost.

        An hour of them, for which nobody may ask, is some ten megabytes.
        """
        self._events.append(event)

    def state(self) -> LiveState:
        """The state now."""
        digest: dict[type, Any] = {bytes: self._digest, tuple: self._begin, str: self._interrupt}
        with self._lock:
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
        from xsens.fusion.online import OnlineFilter  # which loads numba

        self._filter = self._filter or OnlineFilter()
        steps = np.append((1 + missing) / self._now.rate_hz, np.diff(log.time_s))
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
