"""A study's folder: what its sweeps are called in it, and the lock that lets one run at a time work in it."""

from __future__ import annotations

import hashlib
import importlib
import os
import socket
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from speckle3d.core.errors import FileError
from speckle3d.io.hdf5 import make_folder, one_line

LOCK = ".lock"

_HELD: ContextVar[tuple[Path, ...]] = ContextVar("held", default=())
"""Folders that the caller holds already: a study that simulates its sweeps holds its folder for both."""


def named(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Name each file once, by its stem, with as many parent folders as tell it from others of that stem.

    Names depend on the files alone, not on their order: a study given again in another order is the same.
    """
    given = {path.resolve(): path.absolute() for path in reversed(paths)}
    files = [given[target] for target in dict.fromkeys(path.resolve() for path in paths)]
    stems = Counter(path.with_suffix("") for path in files)
    words = [
        # Beside a file that differs in its suffix alone, the suffix belongs to the name.
        [*path.parts[1:-1], path.stem if stems[path.with_suffix("")] == 1 else path.name.replace(".", "-")]
        for path in files
    ]
    depth = [1] * len(files)
    names = _joined(words, depth)
    while alike := [i for i, n in enumerate(names) if names.count(n) > 1 and depth[i] < len(words[i])]:
        for i in alike:
            depth[i] += 1
        names = _joined(words, depth)
    # Folders joined may still be alike: a-b/c and a/b-c.
    unique = [n if names.count(n) == 1 else f"{n}-{_mark(p)}" for n, p in zip(names, files, strict=True)]
    return list(zip(unique, files, strict=True))


@contextmanager
def only_run(directory: Path) -> Iterator[None]:
    """Hold a study's folder, which is made if need be, during the block.

    The operating system releases the lock when the process ends, however it ends; the lock file's text only
    tells the reader of an error who holds it.

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


def _joined(words: Sequence[Sequence[str]], depth: Sequence[int]) -> list[str]:
    return ["-".join(each[-d:]) for each, d in zip(words, depth, strict=True)]


def _mark(path: Path) -> str:
    return hashlib.sha256(str(path).encode()).hexdigest()[:6]


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
