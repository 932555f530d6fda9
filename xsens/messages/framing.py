"""Find messages in bytes and write them: the framing that all of the vendor's sensors share.

A message is ``FA, bus id, message id, length, payload, checksum``; a length of 255 says that a 16-bit length
follows. All bytes after the first, the checksum included, sum to zero modulo 256. Streams start in the middle
of a message and lose bytes, and payloads contain FA too. So a message is accepted wherever its checksum
holds; of two that overlap, the one that another message follows directly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, ByteArray, IntArray
from speckle3d.core.errors import InvalidInputError

PREAMBLE = 0xFA
MASTER = 0xFF
"""Bus id of a single sensor, or of the master among several."""

MOST_PAYLOAD = 8192
"""Longest payload that the vendor's own software accepts; no sensor sends more than 2048 bytes. Lengths
beyond it are damage, and waiting for so many bytes would stop a live stream."""

_EXTENDED = 0xFF
_BLOCK = 1 << 22
"""Bytes scanned at a time, which bounds the memory that a file of nothing but FA takes."""


@dataclass(frozen=True)
class Message:
    """One message, without its framing.

    Attributes
    ----------
    mid : int
        Message id, 0 to 255.
    payload : bytes
        At most `MOST_PAYLOAD` bytes.
    bid : int
        Bus id, 0 to 255.
    """

    mid: int
    payload: bytes = b""
    bid: int = MASTER

    def __post_init__(self) -> None:
        if not (0 <= self.mid <= 255 and 0 <= self.bid <= 255):
            raise InvalidInputError(f"message: expected ids of one byte, got {self.mid} and {self.bid}")
        if len(self.payload) > MOST_PAYLOAD:
            raise InvalidInputError(
                f"message {self.mid:#04x}: expected at most {MOST_PAYLOAD} bytes, got {len(self.payload)}"
            )


def encode(message: Message) -> bytes:
    """Bytes of `message`, with preamble, length and checksum.

    Examples
    --------
    >>> from xsens import Message, encode
    >>> encode(Message(0x30)).hex()
    'faff3000d1'
    """
    size = len(message.payload)
    length = bytes([size]) if size < _EXTENDED else bytes([_EXTENDED, size >> 8, size & 0xFF])
    body = bytes([message.bid, message.mid]) + length + message.payload
    return bytes([PREAMBLE]) + body + bytes([-sum(body) & 0xFF])


def decode(data: bytes) -> list[Message]:
    """Messages in `data`, in order; bytes that belong to none are left out (see `find_frames`).

    Examples
    --------
    >>> from xsens import decode
    >>> decode(bytes.fromhex("0000 faff3000d1 00"))
    [Message(mid=48, payload=b'', bid=255)]
    """
    return list(find_frames(data).messages())


@dataclass(frozen=True)
class Frames:
    """Positions of the messages in a run of bytes.

    Attributes
    ----------
    data : ndarray of uint8, shape (size,)
    start, end : ndarray of int, shape (n,)
        First byte of each message and the one after its checksum; in order, without overlap.
    """

    data: ByteArray
    start: IntArray
    end: IntArray

    def __len__(self) -> int:
        return int(self.start.size)

    def __getitem__(self, which: BoolArray | npt.NDArray[np.integer] | slice) -> Frames:
        if isinstance(which, np.ndarray) and which.dtype != bool and which.size and _without_a_hole(which):
            which = slice(int(which[0]), int(which[-1]) + 1)  # of which NumPy makes no copy
        return Frames(self.data, self.start[which], self.end[which])

    @cached_property
    def bid(self) -> ByteArray:
        """Bus ids, shape (n,)."""
        return np.asarray(self.data[self.start + 1])

    @cached_property
    def mid(self) -> ByteArray:
        """Message ids, shape (n,)."""
        return np.asarray(self.data[self.start + 2])

    @cached_property
    def payload_start(self) -> IntArray:
        """First bytes of the payloads, shape (n,)."""
        head = np.where(self.data[self.start + 3] == _EXTENDED, 6, 4)
        return np.asarray(self.start + head.astype(self.start.dtype))

    @cached_property
    def payload_size(self) -> IntArray:
        """Bytes in the payloads, shape (n,)."""
        return self.end - 1 - self.payload_start

    def payloads(self) -> ByteArray:
        """Payloads as rows, shape (n, size); all must be as long as the first."""
        size = int(self.payload_size[0]) if len(self) else 0
        if not size:
            return np.zeros((len(self), size), dtype=np.uint8)
        return np.asarray(np.lib.stride_tricks.sliding_window_view(self.data, size)[self.payload_start])

    def message(self, index: int) -> Message:
        """The message at `index`."""
        payload = self.data[self.payload_start[index] : self.end[index] - 1].tobytes()
        return Message(int(self.mid[index]), payload, int(self.bid[index]))

    def messages(self) -> Iterator[Message]:
        """All messages, in order."""
        return (self.message(i) for i in range(len(self)))

    def skipped(self) -> list[tuple[int, int]]:
        """Runs of bytes that belong to no message, as (first byte, length)."""
        before = np.concatenate(([0], self.end))
        size = np.concatenate((self.start, [self.data.size])) - before
        there = size > 0
        return list(zip(before[there].tolist(), size[there].tolist(), strict=True))


def _without_a_hole(indices: npt.NDArray[Any]) -> bool:
    """Whether indices rise by one: for those that rise at all, their ends show it."""
    if int(indices[-1]) - int(indices[0]) + 1 != indices.size:
        return False
    return bool((indices[1:] > indices[:-1]).all())


def find_frames(data: bytes | ByteArray) -> Frames:
    """Find every message in `data`, which may hold other bytes before, between and after them.

    Time and memory are proportional to the size of `data`, whatever lengths the bytes claim.
    """
    array = np.frombuffer(data, dtype=np.uint8) if not isinstance(data, np.ndarray) else data
    starts, ends, at = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)], 0
    while at < array.size:
        block = array[at : at + _BLOCK]
        start, end, used = _scan(block, at + _BLOCK >= array.size)
        starts.append(start + at)
        ends.append(end + at)
        at += used
    # Positions take as much memory as short messages: half of it where they fit.
    place = np.int32 if array.size < np.iinfo(np.int32).max else np.int64
    start, end = (np.concatenate([part.astype(place) for part in parts]) for parts in (starts, ends))
    return Frames(array, start, end)


class Framer:
    """Find messages in a live stream that arrives in pieces of any size.

    Attributes
    ----------
    skipped_bytes : int
        Bytes so far that belonged to no message.

    Examples
    --------
    >>> from xsens import Framer
    >>> framer = Framer()
    >>> framer.feed(bytes.fromhex("faff30"))
    []
    >>> framer.feed(bytes.fromhex("00d1"))
    [Message(mid=48, payload=b'', bid=255)]
    """

    def __init__(self) -> None:
        self.skipped_bytes = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Messages that `data` completes; the bytes of an unfinished one are kept for the next call."""
        return self._take(self._rest + data, False)

    def close(self) -> list[Message]:
        """Messages inside an apparent longer one that the end of the stream leaves unfinished."""
        return self._take(self._rest, True)

    def _take(self, data: bytes, final: bool) -> list[Message]:
        array = np.frombuffer(data, dtype=np.uint8)
        start, end, used = _scan(array, final)
        self._rest = data[used:]
        self.skipped_bytes += used - int((end - start).sum())
        return list(Frames(array, start, end).messages())


def _scan(data: ByteArray, final: bool) -> tuple[IntArray, IntArray, int]:
    """First and end bytes of messages in `data`, and how many bytes need not be scanned again.

    Unless `final`, a message that later bytes may complete is not counted among the latter.
    """
    start, end, whole = _candidates(data)
    unfinished = np.zeros(0, dtype=np.int64) if final else start[~whole]
    start, end = start[whole], end[whole]
    valid = _checksum_holds(data, start, end)
    return _chain(start[valid], end[valid], unfinished, data.size)


def _candidates(data: ByteArray) -> tuple[IntArray, IntArray, BoolArray]:
    """First and end bytes of possible messages, and whether `data` holds all of their bytes."""
    start = np.flatnonzero(data == PREAMBLE)
    last = data.size - 1
    length = data[np.minimum(start + 3, last)].astype(np.int64)
    extended = (length == _EXTENDED) & (start + 3 <= last)
    at = np.minimum(start[extended] + 4, last)
    length[extended] = 256 * data[at].astype(np.int64) + data[np.minimum(at + 1, last)]
    end = start + 5 + 2 * extended + length
    header = start + 4 + 2 * extended <= data.size
    plausible = ~header | (length <= MOST_PAYLOAD)
    return start[plausible], end[plausible], (header & (end <= data.size))[plausible]


def _checksum_holds(data: ByteArray, start: IntArray, end: IntArray) -> BoolArray:
    summed = np.cumsum(data, dtype=np.uint8)
    return np.asarray(summed[end - 1] == summed[start])


def _chain(start: IntArray, end: IntArray, unfinished: IntArray, size: int) -> tuple[IntArray, IntArray, int]:
    """Choose among messages that may overlap; also where the first still unfinished one begins."""
    counts = _clear(start, end, unfinished)
    rest = np.flatnonzero(~counts)
    if rest.size:
        next_ = np.minimum(np.searchsorted(start, end[rest]), start.size - 1)
        followed = start[next_] == end[rest]
        chosen = _choose(start[rest].tolist(), end[rest].tolist(), followed.tolist(), unfinished.tolist())
        counts[rest[chosen]] = True
    start, end = start[counts], end[counts]
    waiting = unfinished[unfinished >= (end[-1] if end.size else 0)]
    return start, end, int(waiting[0]) if waiting.size else size


def _clear(start: IntArray, end: IntArray, unfinished: IntArray) -> BoolArray:
    """Mark messages that overlap no other and no unfinished one: nearly all, and they need no choice."""
    if not start.size:
        return np.zeros(0, dtype=bool)
    reach = np.maximum.accumulate(end)
    opens = np.concatenate(([True], start[1:] >= reach[:-1], [True]))
    clear = opens[:-1] & opens[1:]
    if unfinished.size:
        clear &= reach <= unfinished[0]
    return np.asarray(clear)


def _choose(start: list[int], end: list[int], followed: list[bool], unfinished: list[int]) -> list[int]:
    """Indices of the accepted ones among messages that overlap, one after the other."""
    chosen: list[int] = []
    free = wait = i = 0
    while i < len(start):
        if start[i] < free:
            i += 1
            continue
        while wait < len(unfinished) and unfinished[wait] < free:
            wait += 1
        better = i if followed[i] else _followed_within(i, start, end, followed)
        if better > i:
            i = better
            continue
        if not followed[i] and wait < len(unfinished) and unfinished[wait] < start[i]:
            break  # it may lie inside the unfinished one
        chosen.append(i)
        free = end[i]
    return chosen


def _followed_within(i: int, start: list[int], end: list[int], followed: list[bool]) -> int:
    """Index of the first message that begins inside message `i` and is followed by another; else `i`."""
    j = i + 1
    while j < len(start) and start[j] < end[i]:
        if followed[j]:
            return j
        j += 1
    return i
