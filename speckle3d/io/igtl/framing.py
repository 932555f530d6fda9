"""A stream of bytes cut into messages; where it makes no sense, the next message is searched."""

from __future__ import annotations

import re
from collections.abc import Iterator

from fastcrc.crc64 import ecma_182

from speckle3d.io.igtl.header import (
    HEADER_BYTES,
    Header,
    Limits,
    MessageError,
    damaged,
    image_start_bytes,
    read_header,
    require_image_size,
)
from speckle3d.io.igtl.messages import Received, decoded

_START = re.compile(rb"\0[\1-\3](?=[A-Z])")
"""How a header begins: its version and the first letter of its type."""

_MOST_FALSE_STARTS = 4096
_MOST_FALSE_BODIES = 8
"""Headers in a row that no message follows, and their bodies as multiples of the largest."""


class LostError(MessageError):
    """There is no message to be found in what the peer sends."""


class Framing:
    """Cuts a stream into messages, with bounded memory whatever comes.

    A message that is refused costs itself alone: behind its header the next one is searched, so that neither
    a wrong length nor a wrong check sum takes others along.
    """

    def __init__(self, limits: Limits | None = None) -> None:
        self._limits = limits or Limits()
        self._buffer = bytearray()
        self._header: Header | None = None
        self._is_sized = False
        self._searching = False
        self._false_starts = self._false_bytes = 0

    @property
    def within_message(self) -> bool:
        """Whether the peer owes the rest of a message."""
        return bool(self._buffer) and not (self._searching and self._header is None)

    @property
    def wanted_bytes(self) -> int:
        """Bytes up to the end of the header or the body that is being received, at least one."""
        due = HEADER_BYTES + (0 if self._header is None else self._header.body_bytes)
        return max(due - len(self._buffer), 1)

    def feed(self, data: bytes | bytearray | memoryview) -> Iterator[Received | MessageError]:
        """Take bytes and yield messages that are whole, or why one was refused; to be iterated to its end.

        Raises
        ------
        LostError
            If there are too many false beginnings of messages.
        """
        self._buffer += data
        while self._has_header() if self._header is None else True:
            if self._header is None:
                try:
                    self._header = read_header(self._buffer[:HEADER_BYTES], self._limits)
                except MessageError as refused:
                    if not self._searching:
                        yield refused
                        # A body that lacks its last byte, a zero, has taken this header's first one for it.
                        self._buffer[:0] = b"\0\0"
                    self._search()
                continue
            try:
                body = self._body(self._header)
            except MessageError as refused:
                yield refused
                self._count_false(self._header)
                self._search()
                continue
            if body is None:
                return
            header, self._header = self._header, None
            self._is_sized = self._searching = False
            self._false_starts = self._false_bytes = 0
            try:
                yield decoded(header, body)
            except MessageError as refused:  # its length was right: the next message follows it
                yield refused

    def skip(self) -> None:
        """Give up the message that is being received, and search for one in what came of it."""
        self._search()

    def _has_header(self) -> bool:
        if self._searching:
            found = _START.search(self._buffer)
            # The first bytes of a header may be the last ones here.
            del self._buffer[: found.start() if found else max(len(self._buffer) - 2, 0)]
            if not found:
                return False
        return len(self._buffer) >= HEADER_BYTES

    def _body(self, header: Header) -> bytes | None:
        """Take the body at the buffer's start; None if it is not whole.

        Raises
        ------
        MessageError
            If its length or its check sum is wrong.
        """
        end = HEADER_BYTES + header.body_bytes
        start = min(HEADER_BYTES + image_start_bytes(header), end)
        if header.type == "IMAGE" and not self._is_sized and len(self._buffer) >= start:
            require_image_size(header, self._buffer[HEADER_BYTES:start])
            self._is_sized = True
        if len(self._buffer) < end:
            return None
        with memoryview(self._buffer) as view, view[HEADER_BYTES:end] as content:
            if ecma_182(content) != header.crc:
                raise damaged(header)
            body = bytes(content)
        del self._buffer[:end]
        return body

    def _search(self) -> None:
        del self._buffer[:1]
        self._header, self._is_sized, self._searching = None, False, True

    def _count_false(self, header: Header) -> None:
        """Bound the work that a peer can make of headers within bodies of others."""
        self._false_starts += 1
        self._false_bytes += header.body_bytes
        if (
            self._false_starts > _MOST_FALSE_STARTS
            or self._false_bytes > _MOST_FALSE_BODIES * self._limits.max_body_bytes
        ):
            raise LostError("expected messages of OpenIGTLink, got other bytes")
