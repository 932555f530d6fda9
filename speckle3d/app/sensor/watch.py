"""A live sensor that several viewers look at: recorded to a file, asked for its state by one thread alone."""

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

import xsens
from speckle3d.app.sensor.log import COLUMNS, NORMAL_95, Columns, angles, heading_rad
from speckle3d.core.errors import Speckle3DError
from xsens.fusion.field import FieldFound, Trust

INTERVAL_S = 0.1
"""Between two states: a display follows a hand, and the filter takes a percent of it."""
SHOWN_S = 60.0
"""Time that is kept to be shown; a recording keeps all."""


class SensorWatch:
    """Record a sensor on a serial port and keep its last minute of states.

    Parameters
    ----------
    port : str
    record : path, optional
        New file for the sensor's bytes; without it they go to a scratch file, which is removed.
    """

    is_live = True

    def __init__(self, port: str, record: Path | None = None) -> None:
        self._port, self._record = port, record
        self.states: deque[xsens.LiveState] = deque(maxlen=round(SHOWN_S / INTERVAL_S))
        self._end = threading.Event()
        self._failure = ""

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Record the sensor during a block.

        Raises
        ------
        FileError
            If no sensor answers on the port, or the file cannot be written.
        """
        with ExitStack() as stack:
            path = self._record
            if path is None:
                path = Path(stack.enter_context(TemporaryDirectory(prefix="speckle3d-"))) / "sensor.mtb"
            self._recorder = stack.enter_context(xsens.Recorder(self._port, path))
            thread = threading.Thread(target=self._ask, daemon=True)
            thread.start()
            try:
                yield
            finally:
                self._end.set()
                thread.join()

    def _ask(self) -> None:
        next_s = time.monotonic()
        while not self._end.wait(max(next_s - time.monotonic(), 0.0)):
            next_s = max(next_s + INTERVAL_S, time.monotonic())
            try:
                self.states.append(self._recorder.state())
            except Speckle3DError as error:
                self._failure = str(error)
                return

    def columns(self) -> Columns:
        """The last minute, by the time before now."""
        table = np.array([_row(state) for state in list(self.states)], dtype=float).reshape(-1, len(COLUMNS))
        columns = dict(zip(COLUMNS, table.T, strict=True))
        columns["t"] = columns["t"] - columns["t"][-1:]
        rows = np.isfinite(columns["heading"])
        columns["heading"][rows] = np.unwrap(columns["heading"][rows], period=360.0)
        return columns

    def gaps_s(self) -> list[float]:
        """None: losses are counted."""
        return []

    def judgement(self) -> tuple[Trust, str]:
        """Judgement by the filter's last state and its recent rejections."""
        if self._failure:
            return Trust.NO, f"The recording has ended: {self._failure}"
        states = list(self.states)
        if not states:
            return Trust.UNKNOWN, "Waiting for the sensor's first samples."
        last = states[-1]
        if not last.connected:
            return Trust.UNKNOWN, f"The sensor is not connected: {last.note or 'waiting for it'}."
        if last.fused is None or not np.isfinite(last.field):
            lacking = "gyroscope or accelerometer" if last.fused is None else "the magnetometer"
            return Trust.UNKNOWN, f"The magnetometer cannot be judged here: {lacking} is missing."
        if not last.fused.started:
            return Trust.UNKNOWN, "Hold the sensor still: its filter is finding up and north."
        doubts = [
            state.fused.disturbed for state in states if state.fused is not None and state.fused.started
        ]
        fused, disbelieved = last.fused, float(np.mean(doubts))
        sd_rad = float(fused.standard_deviation_rad[2])
        field = FieldFound(sd_rad, disbelieved, fused.field_stray, fused.field_iron)
        return field.trust, field.sentence()

    def orientation_at(self, time_s: float) -> Rotation | None:
        """World from sensor now."""
        return self.states[-1].world_from_sensor if self.states else None

    def facts(self, time_s: float) -> list[tuple[str, str]]:
        """Facts about the present orientation and the received samples."""
        if not self.states:
            return []
        last = self.states[-1]
        place = f"in {self._record}" if self._record else "nowhere: named with --record they are kept"
        return [
            ("sensor", f"on {self._port}" if last.connected else f"NOT CONNECTED: {last.note}"),
            *([] if last.world_from_sensor is None else [angles(last.world_from_sensor)]),
            ("samples", f"{last.samples} in {last.elapsed_s:.0f} s, {last.rate_hz:.1f} per second"),
            ("lost", f"{last.lost} samples, {last.interruptions} interruptions"),
            ("world", "x magnetic north, y west, z up"),
            ("its bytes", place),
        ]


def _row(state: xsens.LiveState) -> tuple[float, ...]:
    """Values of `COLUMNS`, with the time since the beginning."""
    nan = float("nan")
    rate = [nan] * 3 if state.rate_rad_s is None else np.degrees(state.rate_rad_s).tolist()
    heading = half = nan
    if state.world_from_sensor is not None:
        heading = float(np.degrees(heading_rad(state.world_from_sensor)[0]))
    if state.fused is not None and state.fused.started:
        half = NORMAL_95 * float(np.degrees(state.fused.standard_deviation_rad[2]))
    doubt = state.field if state.disturbed else nan
    dip = float(np.degrees(state.dip_rad))
    return (state.elapsed_s, *rate, state.field, dip, heading, half, doubt)
