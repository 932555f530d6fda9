"""Temporary files, told from those that killed processes left."""

from __future__ import annotations

import errno
import importlib
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from speckle3d.core.errors import FileError, NoSpaceError

_NO_SPACE = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""A full disk, a limit on the size of a file, and one on what a user may store."""


def cannot_write(path: str | os.PathLike[str], error: OSError, words: str = "cannot be written") -> FileError:
    """Error of one line for a file that the system refuses to write."""
    kind = NoSpaceError if error.errno in _NO_SPACE else FileError
    reason = (error.strerror or str(error).strip() or type(error).__name__).splitlines()[0]
    return kind(f"{path}: {words}: {reason}")


def part_beside(target: Path) -> Path:
    """Make up the name of a temporary sibling, with the target's suffix."""
    return target.with_name(f".part-{secrets.token_hex(4)}-{target.name}")


@contextmanager
def marked(part: Path) -> Iterator[None]:
    """Make a file that `clear_parts` leaves alone during the block.

    The mark is a lock of the operating system, which ends with the process, however it ends.
    """
    fcntl = locks()
    file = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        if fcntl is not None:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(file, fcntl.LOCK_EX)
        yield
    finally:
        os.close(file)


def clear_parts(target: Path) -> None:
    """Remove temporary siblings of a file that are marked by no process; without locks, none."""
    fcntl = locks()
    own = re.compile(rf"\.part-[0-9a-f]{{8}}-{re.escape(target.name)}")
    try:
        left = [
            each.path for each in os.scandir(target.parent) if own.fullmatch(each.name) and each.is_file()
        ]
    except OSError:  # a folder that may be written, but not listed
        return
    for path in left if fcntl is not None else ():
        with suppress(OSError):  # gone by now, of another user, or marked
            file = os.open(path, os.O_RDONLY)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(path)
            finally:
                os.close(file)


def locks() -> Any:
    """Module of POSIX locks; None on Windows, which has none."""
    try:
        return importlib.import_module("fcntl")
    except ImportError:
        return None
