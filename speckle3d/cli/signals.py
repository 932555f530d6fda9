"""Signals that ask a command for its end: heard once, never lost, and ignored where the parent says so."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDS = ("SIGINT", "SIGTERM", "SIGHUP")
"""Ctrl-C, what `kill` and batch systems send, and what a terminal sends when it is closed."""

_CLEANING_S = 3.0
"""Time after the first of these signals in which others are not heard: temporary files are removed in it.

A closed terminal sends two at once."""

_AGAIN_S = 0.01
"""Until a signal that was dropped is raised once more."""

_ALARM = getattr(signal, "SIGALRM", None)
"""None on Windows, where a dropped signal stays dropped."""


class ToldToStopError(KeyboardInterrupt):
    """A signal asks for the end.

    A plain `KeyboardInterrupt` that passes through code run from C makes Python end by SIGINT, with its code.
    """


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None], *names: str) -> Iterator[None]:
    """Handle signals in a block; those that the process was started to ignore, as by nohup, stay so."""
    before = {}
    if threading.current_thread() is threading.main_thread():  # only the main thread may set handlers
        numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
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
    """Turn signals that ask for the end into `ToldToStopError`; yields a list with the first one's number.

    Where Python can only drop what is raised (finalisers, functions called from C), an alarm raises it again.
    """
    heard: list[int] = []
    first_s, in_hook, show_dropped = 0.0, False, sys.unraisablehook

    def stop(number: int, _frame: FrameType | None) -> None:
        nonlocal first_s
        if number == _ALARM:
            if in_hook:
                return  # raised there it would be lost; the alarm rings again
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        elif not heard:
            first_s = time.monotonic()
            heard.append(number)
        elif time.monotonic() - first_s < _CLEANING_S:
            return
        raise ToldToStopError

    def dropped(what: sys.UnraisableHookArgs) -> None:
        nonlocal in_hook
        in_hook = True
        if not heard:
            show_dropped(what)
        elif _ALARM is not None and isinstance(what.exc_value, ToldToStopError):
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S, _AGAIN_S)
        in_hook = False

    with handled(stop, *ENDS, "SIGALRM"):
        sys.unraisablehook = dropped
        try:
            yield heard
        finally:
            sys.unraisablehook = show_dropped
            if heard:
                if _ALARM is not None:
                    signal.setitimer(signal.ITIMER_REAL, 0.0)
                from speckle3d.core.threads import end_threads

                end_threads()
