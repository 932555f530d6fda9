"""A live sensor that several viewers look at: recorded to a file, asked for its state by one thread alone."""

from __future__ import annotations

import threading
import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

from speckle3d.core.errors import Speckle3DError
from xsens.live.device import DeviceSettings
from xsens.live.monitor import LiveState
from xsens.live.recording import Recorder

INTERVAL_S = 0.1
"""Between two states: a display follows a hand, and the filter takes a percent of it."""

SHOWN_S = 60.0
"""Time that is kept to be shown; a recording keeps all."""


class SensorWatch:
    """Record a sensor on a serial port and keep its last minute of states, within a block.

    Parameters
    ----------
    port : str
    record : path, optional
        New file for the sensor's bytes; without it they go to a scratch file, which is removed.
    settings : DeviceSettings, optional

    Raises
    ------
    FileError
        If no sensor answers on the port, or the file cannot be written.
    """

    def __init__(self, port: str, record: Path | None = None, settings: DeviceSettings | None = None) -> None:
        self.port, self.record = port, record
        self._settings = settings
        self._lock = threading.Lock()
        self._states: deque[LiveState] = deque(maxlen=round(SHOWN_S / INTERVAL_S))
        self._end = threading.Event()
        self.failure = ""

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            path = self.record
            if path is None:
                path = Path(stack.enter_context(TemporaryDirectory(prefix="speckle3d-"))) / "sensor.mtb"
            self._recorder = stack.enter_context(Recorder(self.port, path, self._settings))
            self._thread = threading.Thread(target=self._ask, daemon=True)
            self._thread.start()
            stack.callback(self._thread.join)
            stack.callback(self._end.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def states(self) -> list[LiveState]:
        """States of the last minute, the oldest first."""
        with self._lock:
            return list(self._states)

    def _ask(self) -> None:
        next_s = time.monotonic()
        while not self._end.wait(max(next_s - time.monotonic(), 0.0)):
            next_s = max(next_s + INTERVAL_S, time.monotonic())
            try:
                state = self._recorder.state()
            except Speckle3DError as error:
                self.failure = str(error)
                return
            with self._lock:
                self._states.append(state)
