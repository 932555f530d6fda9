"""Frames deflated in threads and written as HDF5's own filters would, several times faster than HDF5 does.

HDF5 runs its filters one chunk after another and with zlib, which looks for repetitions that echoes do not
have. What is written is the filters' format: shuffled bytes in a zlib stream, read by every HDF5 library.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray

ZLIB_START, LAST_BLOCK = b"\x78\x01", b"\x03\x00"
"""Of a zlib stream, and of one whose last block is empty."""

_MOST_STORED = 0xFFFF
"""Bytes in a block that is not packed; its length is told twice, once with all bits turned."""

_MOST_THREADS = 4
_AHEAD = 2
"""Frames that may wait for each thread."""


def packed_run(run: bytes | memoryview) -> bytes:
    """Pack bytes into blocks that end on a byte and need nothing before them, or store what does not pack."""
    packed = _packer()(run)
    return packed if len(packed) < len(run) else _stored(run)


def shuffled(frame: npt.NDArray[Any]) -> ByteArray:
    """Copy a frame's bytes, first bytes of all samples first."""
    by_sample = frame.reshape(-1).view(np.uint8).reshape(-1, frame.dtype.itemsize)
    return np.array(by_sample.T, order="C")


def deflated(planes: ByteArray) -> bytes:
    """Pack shuffled bytes, a run for each byte of the samples, into a zlib stream [1]_.

    Each run has codes of its own: the last bytes of echoes are noise, stored as they are, and the first ones
    take few values.

    References
    ----------
    .. [1] P. Deutsch, RFC 1950 and RFC 1951, 1996: blocks that end on a byte follow one another.
    """
    blocks = (packed_run(plane.data) for plane in planes)
    return b"".join((ZLIB_START, *blocks, LAST_BLOCK, struct.pack(">I", zlib.adler32(planes.data))))


@cache
def _packer() -> Callable[[bytes | memoryview], bytes]:
    """Function that packs a run into blocks that end on a byte: ISA-L's, or zlib's where it is missing."""
    try:
        from isal import isal_zlib
    except ImportError:
        return packed_by_zlib

    def packed_by_isal(run: bytes | memoryview) -> bytes:
        packer = isal_zlib.compressobj(1, isal_zlib.DEFLATED, -zlib.MAX_WBITS)
        return bytes(packer.compress(run) + packer.flush(zlib.Z_FULL_FLUSH))

    return packed_by_isal


def packed_by_zlib(run: bytes | memoryview) -> bytes:
    """Pack a run; of the repetitions in echoes, only those of single bytes are worth their search."""
    packer = zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_RLE)
    return packer.compress(run) + packer.flush(zlib.Z_FULL_FLUSH)


def _stored(run: bytes | memoryview) -> bytes:
    pieces = (bytes(run[first : first + _MOST_STORED]) for first in range(0, len(run), _MOST_STORED))
    return b"".join(struct.pack("<BHH", 0, len(p), _MOST_STORED - len(p)) + p for p in pieces)


class DeflatingWriter:
    """Appends frames to a data set of one chunk a frame, with filters shuffle and deflate.

    Frames are written in order, a few after they were appended.

    Parameters
    ----------
    data : h5py.h5d.DatasetID
        Of no frames yet.
    check : callable
        Called after each frame that was written.
    """

    def __init__(self, data: Any, check: Callable[[], None]) -> None:
        self._data, self._check = data, check
        self._threads = min(_MOST_THREADS, os.cpu_count() or 1)
        self._pool = ThreadPoolExecutor(self._threads, "deflate")
        self._ahead: deque[Future[bytes]] = deque()
        self._written = 0

    def append(self, frame: npt.NDArray[Any]) -> None:
        """Append a frame, shape (vector, sample) or (vector, sample, 2)."""
        self._ahead.append(self._pool.submit(deflated, shuffled(frame)))
        while len(self._ahead) > _AHEAD * self._threads:
            self._write_next()

    def finish(self) -> None:
        """Write what still waits."""
        while self._ahead:
            self._write_next()

    def close(self) -> None:
        """Drop what still waits, and end the threads."""
        self._pool.shutdown(cancel_futures=True)

    def _write_next(self) -> None:
        packed = self._ahead.popleft().result()
        shape = self._data.shape
        self._data.set_extent((self._written + 1, *shape[1:]))
        self._data.write_direct_chunk((self._written, *(0,) * (len(shape) - 1)), packed)
        self._written += 1
        self._check()
