"""Handling of signals that ask a command to end."""

import signal
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDS = ("SIGINT", "SIGTERM", "SIGHUP")
"""Ctrl-C, what `kill` and batch systems send, and what a terminal sends when it is closed."""

_CLEANING_S = 3.0
"""Time after the first of these signals in which others are not heard: temporary files are removed in it.

A closed terminal sends two at once."""


_AGAIN_S = 0.01
"""After which a signal is sent again that came where nothing can be raised."""


class ToldToStopError(KeyboardInterrupt):
    """A signal asked the command to end.

    A plain `KeyboardInterrupt` that passes through code run from C makes Python end by SIGINT, with its code.
    """


@contextmanager
def handle_ends(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle signals that ask for the end; those that the process must ignore, as by nohup, stay so."""
    before = {}
    if threading.current_thread() is threading.main_thread():  # only the main thread may set handlers
        numbers = [getattr(signal, name) for name in ENDS if hasattr(signal, name)]
        before = {n: was for n in numbers if (was := signal.getsignal(n)) not in (signal.SIG_IGN, None)}
    try:
        for number in before:
            signal.signal(number, handler)
        yield
    finally:
        for number, was in before.items():
            signal.signal(number, was)


@contextmanager
def stoppable() -> Iterator[list[int]]:
    """Turn signals that ask for the end into `ToldToStopError`; yields a list with the first one's number."""
    heard: list[int] = []
    first_s = 0.0

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal first_s
        if _swallows(frame):
            threading.Timer(_AGAIN_S, signal.raise_signal, [number]).start()
            return
        if not heard:
            first_s = time.monotonic()
            heard.append(number)
        elif time.monotonic() - first_s < _CLEANING_S:
            return
        raise ToldToStopError

    with handle_ends(stop):
        try:
            yield heard
        finally:
            if heard:
                from speckle3d.core.threads import end_threads

                end_threads()


def _swallows(frame: FrameType | None) -> bool:
    """Whether what is raised here is lost: in finalizers and callbacks of weak references."""
    while frame is not None:
        if frame.f_code.co_name == "__del__" or frame.f_code.co_filename == weakref.__file__:
            return True
        frame = frame.f_back
    return False
