"""Memory for arrays of a frame's size, kept for the next frame.

The system hands out large pieces of memory in pages, and clears each at its first use. That takes longer than
filling them.
"""

from __future__ import annotations

import math
import sys
from collections import defaultdict
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray

_ALIGNED_BYTES = 64
"""A vector register, and a line of the processor's caches."""
_PIECE_BYTES = 2**16
"""Sizes are rounded up to it, so that arrays of nearly one size share their memory."""
_MOST_BYTES = 2**27
"""Kept in all, in use or not; a frame of 127 vectors needs a few megabytes, and a dozen are in hand."""
_listed = [object()]
_UNUSED = sys.getrefcount(_listed[0])
"""References to what is in a list alone, the count's own among them."""

_pieces: defaultdict[int, list[ByteArray]] = defaultdict(list)
_lock = Lock()


def borrowed(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return an array that holds anything, of memory that was used before if there is any of its size.

    It is an array like any other; its memory is used again once nothing refers to it.
    """
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    rounded = -(-size // _PIECE_BYTES) * _PIECE_BYTES
    with _lock:
        return _piece(rounded)[:size].view(kind).reshape(shape)


def _piece(size: int) -> ByteArray:
    """A view of memory that no other array looks at; while it lives, none is given the same."""
    kept = _pieces[size]
    for k in range(len(kept)):
        # Every array over a piece refers to the piece itself, however many views are between.
        if sys.getrefcount(kept[k]) == _UNUSED:
            return _aligned(kept[k])
    memory = np.empty(size + _ALIGNED_BYTES, np.uint8)
    if _make_room(size):
        kept.append(memory)
    return _aligned(memory)


def _make_room(size: int) -> bool:
    """Let go of what is not in use until there is room for one more; whether there is."""
    room = _MOST_BYTES - size - sum(each * len(kept) for each, kept in _pieces.items())
    for other, kept in _pieces.items():
        if room >= 0:
            break
        for k in reversed(range(len(kept))):
            if other != size and sys.getrefcount(kept[k]) == _UNUSED:
                del kept[k]
                room += other
    return room >= 0


def _aligned(memory: ByteArray) -> ByteArray:
    first = -memory.ctypes.data % _ALIGNED_BYTES
    return memory[first : memory.size - _ALIGNED_BYTES + first]
