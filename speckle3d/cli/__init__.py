"""The command line. Heavy modules are imported inside the commands, so that help and errors come at once."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

# Small factorisations lose far more to a team of threads than they gain; set before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

# Importing a module of commands registers them.
from speckle3d.cli import compare, expect, files, reconstruction, simulate, trajectory  # noqa: F401
from speckle3d.cli.calibrate import clock, curves, images, phantoms  # noqa: F401
from speckle3d.cli.common import app, emit, note
from speckle3d.cli.look import measure, reslices, scenes, surfaces, view, volumes  # noqa: F401
from speckle3d.cli.sensors import imu, imu_accuracy  # noqa: F401
from speckle3d.cli.stream import live, play  # noqa: F401
from speckle3d.core.errors import NoSpaceError, Speckle3DError

__all__ = ["app", "main"]

_STOPS = ("SIGINT", "SIGTERM", "SIGHUP")
"""Ctrl-C, what `kill` and batch systems send, and what a terminal sends when it is closed."""

_OBJECTS_BETWEEN_COLLECTIONS = 10_000
"""New objects after which Python looks for those that only hold each other.

At its own 700 it looks through all modules several times while they are imported: a tenth of a short command.
"""

_CLEANING_S = 3.0
"""Time after the first of these signals in which others are not heard: temporary files are removed in it.

A closed terminal sends two at once."""

_AGAIN_S = 0.01
"""Until a signal that was dropped is sent once more."""

_STOPPED = 128 + signal.SIGINT
"""Exit code after Ctrl-C, as shells have it."""


class _ToldToStopError(KeyboardInterrupt):
    """A signal asks for the end.

    A plain `KeyboardInterrupt` that passes through code run from C makes Python end by SIGINT, with its code.
    """


def main() -> None:
    """Run the command line.

    A wrong input is one line on stderr and exit code 2, a full disk one and exit code 1. Signals that ask for
    the end stop the command as Ctrl-C does, with exit code 128 and their number.
    """
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    with _stoppable() as heard, warnings.catch_warnings():
        warnings.showwarning = _warn
        _run(heard)


def _warn(message: Warning | str, *_: object, **__: object) -> None:
    note(f"speckle3d: {' '.join(str(message).split())}")


def _run(heard: list[int]) -> None:
    try:
        code = app(standalone_mode=False, prog_name="speckle3d")
    except Speckle3DError as error:
        _fail(str(error), 1 if isinstance(error, NoSpaceError) else 2)
    except (KeyboardInterrupt, typer.Abort):
        _fail("stopped", 128 + heard[0] if heard else _STOPPED)
    except typer.Exit as leave:
        sys.exit(leave.exit_code)
    except Exception as error:
        if heard:  # a signal that is dropped within a compilation makes it fail in its own way
            _fail("stopped", 128 + heard[0])
        # Typer's own usage errors carry an exit code; anything else is a bug and shows its traceback.
        if not hasattr(error, "format_message"):
            raise
        # Called with no command at all: its message is the help.
        if type(error).__name__ == "NoArgsIsHelpError":
            emit(error.format_message())
            sys.exit(2)
        _fail(error.format_message())
    # Typer turns Ctrl-C into this exit code without a word; a recording ends with it and is whole.
    if code == _STOPPED or (heard and heard[0] != signal.SIGINT):
        _fail("stopped", 128 + heard[0] if heard else _STOPPED)
    sys.exit(code if isinstance(code, int) else 0)


@contextmanager
def _stoppable() -> Iterator[list[int]]:
    """Turn signals that ask for the end into `KeyboardInterrupt`; yields a list with the first one's number.

    A signal that the process was started to ignore, as SIGHUP by nohup, stays ignored. One that arrives where
    Python can only drop what is raised (finalisers, functions called from C) is sent once more.
    """
    heard: list[int] = []
    first_s, sending, show_dropped = 0.0, False, sys.unraisablehook

    def stop(number: int, _frame: FrameType | None) -> None:
        nonlocal first_s
        if not heard:
            first_s = time.monotonic()
            heard.append(number)
        elif sending or time.monotonic() - first_s < _CLEANING_S:
            return
        raise _ToldToStopError

    def send_again() -> None:
        time.sleep(_AGAIN_S)
        while sending:
            time.sleep(_AGAIN_S)
        os.kill(os.getpid(), heard[0])

    def dropped(what: sys.UnraisableHookArgs) -> None:
        nonlocal first_s, sending
        if not heard:
            show_dropped(what)
        elif isinstance(what.exc_value, _ToldToStopError):
            # Starting a thread takes long on a busy machine; what is raised in here would be dropped, too.
            sending, first_s = True, -_CLEANING_S
            threading.Thread(target=send_again, daemon=True).start()
            sending = False

    before = {}
    if threading.current_thread() is threading.main_thread():  # only the main thread may set handlers
        numbers = [getattr(signal, name) for name in _STOPS if hasattr(signal, name)]
        before = {each: signal.getsignal(each) for each in numbers}
        before = {each: was for each, was in before.items() if was not in (signal.SIG_IGN, None)}
        for each in before:
            signal.signal(each, stop)
        sys.unraisablehook = dropped
    try:
        yield heard
    finally:
        sys.unraisablehook = show_dropped
        for each, was in before.items():
            signal.signal(each, was)
        if heard:
            from speckle3d.core.threads import end_threads

            end_threads()


def _fail(message: str, code: int = 2) -> None:
    note(f"speckle3d: {' '.join(message.split())}")
    sys.exit(code)
