"""Temporary files: told from those that killed processes left, and safe for HDF5 on a disk that fills up."""

from __future__ import annotations

import errno
import importlib
import io
import os
import re
import secrets
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

from speckle3d.core.errors import FileError, NoSpaceError

_NO_SPACE = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""A full disk, a limit on the size of a file, and one on what a user may store."""

_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Those that ask a process to end."""


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


class _Nowhere(io.RawIOBase):
    """File that takes everything and holds nothing."""

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        return 0 if whence == os.SEEK_END else offset

    def readinto(self, buffer: Any, /) -> int:
        return 0

    def write(self, data: Any, /) -> int:
        return memoryview(data).nbytes

    def truncate(self, size: int | None = None, /) -> int:
        return size or 0


class DiskFile:
    """File for HDF5 to write into, by which a full disk is an ordinary error.

    HDF5 cannot close a file whose bytes it cannot write, and takes the interpreter down with it. Here every
    write succeeds: from the first one that the system refuses on they are kept in memory, and `check` raises
    the system's error. To be called after every piece of a file that may become large.

    HDF5 also swallows what is raised while it calls the methods below. So a signal that arrives there, as
    Ctrl-C does, waits for `check` or for the end of the block. What HDF5 still writes behind a block that
    ended by an error goes nowhere.

    Parameters
    ----------
    path : path
        Written anew, unless `keep` is set: then changed.
    """

    def __init__(self, path: Path, keep: bool = False) -> None:
        # Closed with the block.
        self._file: io.RawIOBase = open(path, "r+b" if keep else "w+b", buffering=0)  # noqa: SIM115
        self._at = 0
        self._failure: OSError | None = None
        self._kept: list[tuple[int, bytes]] = []
        self._handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
        self._waiting: list[int] = []

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # the only one that sees signals
            found = {number: signal.getsignal(number) for number in _SIGNALS}
            self._handlers = {number: was for number, was in found.items() if callable(was)}
            for number in self._handlers:
                signal.signal(number, self._hear)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, was in self._handlers.items():
            signal.signal(number, was)
        try:
            self._file.close()
        finally:
            if kind is None:
                self.check()
            else:
                # HDF5 closes its side when the last object of the file goes, which a traceback may hold.
                self._file = _Nowhere()

    def check(self) -> None:
        """Handle signals that wait, and raise the `OSError` of the first write that the system refused."""
        while self._waiting:
            number = self._waiting.pop(0)
            self._handlers[number](number, None)
        if self._failure is not None:
            raise self._failure

    def _hear(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal at once, unless HDF5 is calling."""
        caller = frame
        while caller is not None:
            if caller.f_code in _CALLED_BY_HDF5:
                self._waiting.append(number)
                return
            caller = caller.f_back
        self._handlers[number](number, frame)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to an offset, from the end if `whence` is 2."""
        self._at = offset
        if whence == os.SEEK_END:
            ends = [at + len(data) for at, data in self._kept]
            self._at += max([self._file.seek(0, os.SEEK_END), *ends])
        return self._at

    def tell(self) -> int:
        """Return the offset of the next byte."""
        return self._at

    def read(self, size: int) -> bytes:
        """Return `size` bytes; zeros behind the end. By this method h5py tells a file from a path."""
        found = bytearray(size)
        self.readinto(memoryview(found))
        return bytes(found)

    def readinto(self, buffer: memoryview) -> int:
        """Fill a buffer; with zeros behind the end."""
        self._file.seek(self._at)
        view, count = memoryview(buffer).cast("B"), 0
        while count < len(view) and (got := self._file.readinto(view[count:])):
            count += got
        view[count:] = bytes(len(view) - count)
        for at, data in self._kept:
            first, last = max(at, self._at), min(at + len(data), self._at + len(view))
            if first < last:
                view[first - self._at : last - self._at] = data[first - at : last - at]
        self._at += len(view)
        return len(view)

    def write(self, data: memoryview) -> int:
        """Write bytes to the file, or into memory once it takes no more."""
        at, view = self._at, memoryview(data).cast("B")
        self._at += len(view)
        if self._failure is None:
            try:
                self._file.seek(at)
                left = view
                while left:
                    left = left[self._file.write(left) :]
            except OSError as error:
                self._failure = error
        if self._failure is not None:
            self._kept.append((at, bytes(view)))
        return len(view)

    def truncate(self, size: int) -> int:
        """Cut the file off, or lengthen it."""
        if self._failure is None:
            try:
                self._file.truncate(size)
            except OSError as error:
                self._failure = error
        return size

    def flush(self) -> None:
        """Do nothing: no write is buffered."""


_CALLED_BY_HDF5 = {
    each.__code__
    for each in (
        DiskFile.seek,
        DiskFile.tell,
        DiskFile.read,
        DiskFile.readinto,
        DiskFile.write,
        DiskFile.truncate,
        DiskFile.flush,
    )
}
