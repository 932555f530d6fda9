"""Files given by name: opened only if they are files, so that nothing waits for a pipe or reads a device."""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from typing import TypeAlias

from speckle3d.core.errors import FileError

PathLike: TypeAlias = str | os.PathLike[str]


def open_regular(path: PathLike) -> BufferedReader:
    """Open an ordinary file for reading bytes; a link is followed.

    Raises
    ------
    FileError
        If there is none, it cannot be read, or it is a folder, a pipe, a socket or a device.
    """
    try:
        # A pipe without a writer would wait.
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise FileError(f"{path}: expected a file, got a folder, pipe or device")
        return open(path, "rb")
    except FileError:
        raise
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
