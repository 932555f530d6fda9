"""One run at a time in a study's folder."""

from __future__ import annotations

import importlib
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from speckle3d.core.errors import FileError
from speckle3d.io.hdf5 import make_folder, one_line

LOCK = ".lock"

_HELD: ContextVar[tuple[Path, ...]] = ContextVar("held", default=())
"""Folders that the caller holds already: a study that simulates its sweeps holds its folder for both."""


@contextmanager
def only_run(directory: Path) -> Iterator[None]:
    """Hold a study's folder, which is made if need be, during the block.

    The system's lock on a file goes with the process that holds it, however that ends; what the file says is
    for the reader of an error alone.

    Raises
    ------
    FileError
        If another run holds it, or the folder cannot be written.
    """
    folder = directory.resolve()
    if folder in _HELD.get():
        yield
        return
    make_folder(folder)
    try:
        file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise FileError(f"{directory}: cannot be written: {one_line(error)}") from error
    token = None
    try:
        _take(file, directory)
        token = _HELD.set((*_HELD.get(), folder))
        yield
    finally:
        if token is not None:
            _HELD.reset(token)
        os.close(file)


def _take(file: int, directory: Path) -> None:
    try:
        fcntl = importlib.import_module("fcntl")
    except ImportError:  # Windows has none
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        who = os.pread(file, 200, 0).decode("utf-8", "replace").strip() or "another process"
        raise FileError(
            f"{directory}: expected a folder that no other run is at work in, got one held by {who}"
        ) from None
    except OSError:
        return  # a file system without locks
    os.truncate(file, 0)
    os.pwrite(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
