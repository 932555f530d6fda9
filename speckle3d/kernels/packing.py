"""Length of packed bytes, without unpacking them."""

from __future__ import annotations

from numba import njit

from speckle3d.core.arrays import ByteArray


@njit(cache=True, fastmath=False)
def lzf_length(packed: ByteArray) -> int:
    """Count the bytes that a run packed by LibLZF unpacks to; -1 where it ends within a piece.

    A piece is either up to 32 bytes as they are, behind their number less one, or a repetition of 2 to 264
    bytes: three bits of length, thirteen of distance, and a byte more of length if the three are set.
    """
    at, length, size = 0, 0, packed.size
    while at < size:
        head = int(packed[at])
        if head < 32:
            at += head + 2
            length += head + 1
            continue
        count = head >> 5
        if count == 7:
            if at + 1 >= size:
                return -1
            count += int(packed[at + 1])
            at += 1
        at += 2
        length += count + 2
    return length if at == size else -1
