"""Files given by name: opened only if they are files, so that nothing waits for a pipe, and written whole.

Those that killed processes leave half written have names of their own, and are removed.
"""

import errno
import glob
import importlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any

from speckle3d.core.errors import FileError, NoSpaceError

PathLike = str | os.PathLike[str]

_NO_SPACE = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""A full disk, a limit on the size of a file, and one on what a user may store."""


def open_regular(path: PathLike) -> BufferedReader:
    """Open an ordinary file for reading bytes; a link is followed.

    Raises
    ------
    FileError
        If there is none, it cannot be read, or it is a folder, a pipe, a socket or a device.
    """
    # A pipe without a writer would wait.
    if os.path.exists(path) and not os.path.isfile(path):
        raise FileError(f"{path}: expected a file, got a folder, pipe or device")
    try:
        return open(path, "rb")
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def cannot_write(path: PathLike, error: OSError, words: str = "cannot be written") -> FileError:
    """Error of one line for a file that the system refuses to write."""
    kind = NoSpaceError if error.errno in _NO_SPACE else FileError
    reason = (error.strerror or str(error) or type(error).__name__).splitlines()[0]
    return kind(f"{path}: {words}: {reason}")


@contextmanager
def whole_file(target: Path) -> Iterator[Path]:
    """Yield a temporary sibling, with the target's suffix, that takes its place if the block succeeds.

    A lock of the operating system marks it, which ends with the process, however it ends; siblings without,
    which killed processes left, are removed.

    Raises
    ------
    FileError
        If the system refuses to write.
    """
    fcntl = locks()
    left = target.parent.glob(f".part-{'[0-9a-f]' * 8}-{glob.escape(target.name)}")
    for path in left:
        # Gone by now, of another user, or at work; or there are no locks to tell by.
        with suppress(OSError, AttributeError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()
    part = target.with_name(f".part-{secrets.token_hex(4)}-{target.name}")
    try:
        with part.open("xb") as file:
            with suppress(OSError, AttributeError):  # a system or a file system without locks
                fcntl.flock(file, fcntl.LOCK_EX)
            yield part
            os.replace(part, target)
    except FileError:
        raise
    except OSError as error:
        raise cannot_write(target, error) from error
    finally:
        with suppress(OSError):  # none was made, or the folder has gone
            part.unlink()


def locks() -> Any:
    """Module of POSIX locks; None on Windows, which has none."""
    try:
        return importlib.import_module("fcntl")
    except ImportError:
        return None
