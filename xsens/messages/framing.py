"""Find messages in bytes and write them: the framing that all of the vendor's sensors share.

A message is ``FA, bus id, message id, length, payload, checksum``; a length of 255 says that a 16-bit length
follows. All bytes after the first, the checksum included, sum to zero modulo 256. Streams start in the middle
of a message and lose bytes, and payloads contain FA too. So a message is accepted wherever its checksum
holds; of two that overlap, the one that another message follows directly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from speckle3d.core.arrays import ByteArray, IntArray

PREAMBLE = 0xFA

MOST_PAYLOAD = 8192
"""Longest payload that the vendor's own software accepts; no sensor sends more than 2048 bytes. Lengths
beyond it are damage, and waiting for so many bytes would stop a live stream."""

_LONG_LENGTH = 0xFF


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
        Bus id, 0 to 255; 255 is a single sensor, or the master among several.
    """

    mid: int
    payload: bytes = b""
    bid: int = 0xFF


def encode(message: Message) -> bytes:
    """Bytes of `message`, with preamble, length and checksum.

    Parameters
    ----------
    message : Message

    Returns
    -------
    bytes
        From preamble to check sum.

    Examples
    --------
    >>> from xsens import Message, encode
    >>> encode(Message(0x30)).hex()
    'faff3000d1'
    """
    size = len(message.payload)
    length = bytes([size]) if size < _LONG_LENGTH else bytes([_LONG_LENGTH, size >> 8, size & 0xFF])
    body = bytes([message.bid, message.mid]) + length + message.payload
    return bytes([PREAMBLE]) + body + bytes([-sum(body) & 0xFF])


def decode(data: bytes) -> list[Message]:
    """Messages in `data`, in order; bytes that belong to none are left out (see `find_frames`).

    Parameters
    ----------
    data : bytes
        Any run of bytes.

    Returns
    -------
    list of Message

    Examples
    --------
    >>> from xsens import decode
    >>> decode(bytes.fromhex("0000 faff3000d1 00"))
    [Message(mid=48, payload=b'', bid=255)]
    """
    return find_frames(data).messages()


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

    def __getitem__(self, index: Any) -> Frames:
        return Frames(self.data, self.start[index], self.end[index])

    @cached_property
    def bid(self) -> ByteArray:
        """Bus ids, shape (n,)."""
        return self.data[self.start + 1]

    @cached_property
    def mid(self) -> ByteArray:
        """Message ids, shape (n,)."""
        return self.data[self.start + 2]

    @cached_property
    def payload_start(self) -> IntArray:
        """First bytes of the payloads, shape (n,)."""
        return self.start + np.where(self.data[self.start + 3] == _LONG_LENGTH, 6, 4)

    @cached_property
    def payload_size(self) -> IntArray:
        """Bytes in the payloads, shape (n,)."""
        return self.end - 1 - self.payload_start

    def message(self, index: int) -> Message:
        """The message at `index`."""
        payload = self.data[self.payload_start[index] : self.end[index] - 1].tobytes()
        return Message(int(self.mid[index]), payload, int(self.bid[index]))

    def messages(self) -> list[Message]:
        """All messages, in order."""
        return [self.message(i) for i in range(len(self))]

    def gaps(self) -> list[tuple[int, int]]:
        """Runs of bytes that belong to no message, as (first byte, length)."""
        before = np.concatenate(([0], self.end))
        size = np.concatenate((self.start, [self.data.size])) - before
        positive = size > 0
        return list(zip(before[positive].tolist(), size[positive].tolist(), strict=True))


def rows_at(data: ByteArray, start: IntArray, size: int) -> ByteArray:
    """The `size` bytes from each of `start` on, shape (n, size)."""
    # As single values of so many bytes, which NumPy copies in half the time of a row of bytes.
    windows = np.ndarray(data.size - size + 1, f"V{size}", buffer=data, strides=(1,))
    return windows[start].view(np.uint8).reshape(-1, size)


def find_frames(data: bytes | ByteArray) -> Frames:
    """Find every message in `data`, which may hold other bytes before, between and after them."""
    array = np.frombuffer(data, dtype=np.uint8)
    start, end, _ = _scan(array)
    return Frames(array, start, end)


class Framer:
    """Find messages in a live stream that arrives in pieces of any size.

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
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Messages that `data` completes; the bytes of an unfinished one are kept for the next call."""
        data = self._rest + data
        array = np.frombuffer(data, dtype=np.uint8)
        start, end, stop = _scan(array)
        self._rest = data[stop:]
        return Frames(array, start, end)[start < stop].messages()


def _scan(data: ByteArray) -> tuple[IntArray, IntArray, int]:
    """First and end bytes of messages in `data`, and where a message may begin that later bytes complete."""
    start = np.flatnonzero(data == PREAMBLE)
    tail = np.append(data, np.zeros(5, dtype=np.uint8))
    size, high, low = (tail[start + k].astype(np.int64) for k in (3, 4, 5))
    long = size == _LONG_LENGTH
    size = np.where(long, 256 * high + low + 2, size)
    plausible = size <= MOST_PAYLOAD + 2 * long
    start, end = start[plausible], (start + 5 + size)[plausible]
    whole = end <= data.size  # without the whole head it is not, as what is missing is taken for zeros
    partial = start[~whole]
    start, end = start[whole], end[whole]
    sums = np.cumsum(data, dtype=np.uint8)
    valid = sums[end - 1] == sums[start]
    start, end = _without_overlaps(start[valid], end[valid])
    before = np.append(0, end)[np.searchsorted(start, partial)]
    waiting = partial[before <= partial]  # not inside an accepted one
    return start, end, int(waiting[0]) if waiting.size else data.size


def _without_overlaps(start: IntArray, end: IntArray) -> tuple[IntArray, IntArray]:
    """Messages without those that begin inside another, or hold the beginning of one followed by another."""
    if not start.size:
        return start, end
    opens = np.concatenate(([True], start[1:] >= np.maximum.accumulate(end)[:-1], [True]))
    accepted, free = opens[:-1] & opens[1:], 0  # nearly all overlap no other
    continued = start[np.minimum(np.searchsorted(start, end), start.size - 1)] == end
    for i in np.flatnonzero(~accepted).tolist():
        rivals = continued[i + 1 : np.searchsorted(start, end[i])]
        if start[i] >= free and (continued[i] or not rivals.any()):
            accepted[i], free = True, end[i]
    return start[accepted], end[accepted]
