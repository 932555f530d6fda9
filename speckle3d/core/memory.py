"""Memory for arrays of a frame's size, kept for the next frame.

The system hands out large pieces of memory in pages, and clears each at its first use. That takes longer than
filling them.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import ByteArray

_ALIGNED_BYTES = 64
"""A vector register, and a line of the processor's caches."""
_PIECE_BYTES = 2**16
"""Sizes are rounded up to it, so that arrays of nearly one size share their memory."""
_MOST_KEPT, _MOST_SIZES = 8, 16
"""Pieces of one size that wait to be used again, and sizes: a sweep's frames need half a dozen."""

_waiting: defaultdict[int, deque[ByteArray]] = defaultdict(deque)


class _Loan:
    """Memory of one array and its views, which goes back when the last of them is gone."""

    def __init__(self, memory: ByteArray) -> None:
        self._memory = memory
        self.__array_interface__ = memory.__array_interface__

    def __del__(self, _waiting: defaultdict[int, deque[ByteArray]] = _waiting) -> None:
        # Bound here because names of the module may be gone when the interpreter ends.
        pieces = _waiting[self._memory.size]
        if len(pieces) < _MOST_KEPT:
            pieces.append(self._memory)


def borrowed(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return an array that holds anything, of memory that was used before if there is any of its size.

    It is an array like any other; its memory is used again once nothing refers to it.
    """
    kind = np.dtype(dtype)
    size = math.prod(shape) * kind.itemsize
    rounded = -(-size // _PIECE_BYTES) * _PIECE_BYTES
    try:
        memory = _waiting[rounded].pop()
    except IndexError:
        if len(_waiting) > _MOST_SIZES:
            _waiting.clear()
        memory = _aligned(rounded)
    return np.asarray(_Loan(memory))[:size].view(kind).reshape(shape)


def _aligned(size: int) -> ByteArray:
    memory = np.empty(size + _ALIGNED_BYTES, np.uint8)
    first = -memory.ctypes.data % _ALIGNED_BYTES
    return memory[first : first + size]
