"""One socket to a peer, read and written by two threads, with bounded memory on either way."""

from __future__ import annotations

import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

from speckle3d.core.errors import InvalidInputError
from speckle3d.io.igtl.framing import Framing, LostError
from speckle3d.io.igtl.messages import ImageReceived, Limits, MessageError, Received

_PIECE_BYTES = 2**18
_LOOK_S = 0.1
"""How often a waiting thread looks whether it is to end."""

_SMALL_BYTES = 512
"""Counted for a message beside its pixels."""


@dataclass(frozen=True)
class LinkState:
    """What has happened on a connection.

    Attributes
    ----------
    connected : bool
        For a server, whether there is a client.
    messages : int
        Received and understood.
    refused : int
        Messages that made no sense; `last_refused` says why the last one did not.
    reconnections : int
        Times the connection was lost and found again; for a server, clients beyond the first.
    dropped : int
        Messages to the peer that it was too slow for.
    waiting : int
        Messages received and not yet taken.
    silent_s : float
        Time since the last byte came.
    last_failure : str
        Why the connection was lost, or there is none.
    """

    connected: bool = False
    messages: int = 0
    refused: int = 0
    last_refused: str = ""
    reconnections: int = 0
    dropped: int = 0
    waiting: int = 0
    silent_s: float = 0.0
    last_failure: str = ""


class Inbox:
    """Messages received and not yet taken, in order; a full one makes its peers wait. None is dropped.

    Parameters
    ----------
    limits : Limits
    """

    def __init__(self, limits: Limits) -> None:
        self._most = limits.max_waiting_bytes
        self._changed = threading.Condition()
        self._held: deque[Received] = deque()
        self._bytes = 0
        self._closed = False
        self._state, self._heard_s = LinkState(), time.monotonic()

    def put(self, message: Received, over: threading.Event) -> None:
        """Append a message as soon as there is room; not at all if its connection is over before."""
        with self._changed:
            while self._bytes >= self._most:
                if over.is_set():
                    return
                self._changed.wait(_LOOK_S)
            self._held.append(message)
            self._bytes += _size(message)
            self._state = replace(self._state, messages=self._state.messages + 1)
            self._changed.notify_all()

    def take(self, timeout_s: float) -> list[Received]:
        """Take all messages, waiting for the first one; none if the time is over or the inbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or bool(self._held), timeout_s)
            taken = list(self._held)
            self._held.clear()
            self._bytes = 0
            self._changed.notify_all()
            return taken

    def heard(self) -> None:
        """Note that bytes came."""
        self._heard_s = time.monotonic()

    def refuse(self, error: MessageError) -> None:
        """Count a message that made no sense."""
        with self._changed:
            self._state = replace(self._state, refused=self._state.refused + 1, last_refused=str(error))

    def note(self, connected: bool, failure: str = "", reconnections: int = 0) -> None:
        """Note that a connection was made or lost."""
        with self._changed:
            if connected:
                self._heard_s = time.monotonic()
            self._state = replace(
                self._state,
                connected=connected,
                reconnections=self._state.reconnections + reconnections,
                last_failure=failure or self._state.last_failure,
            )

    def state(self) -> LinkState:
        """What has happened so far, but for what was sent."""
        with self._changed:
            silent_s = time.monotonic() - self._heard_s
            return replace(self._state, waiting=len(self._held), silent_s=silent_s)

    def close(self) -> None:
        """Let nobody wait any longer."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Outbox:
    """Messages to a peer that are not yet sent; of too many the oldest are dropped."""

    def __init__(self, limits: Limits) -> None:
        self._most = limits.max_sending_bytes
        self._changed = threading.Condition()
        self._held: deque[bytes] = deque()
        self._bytes = self._in_hand = 0
        self.dropped = 0

    def put(self, message: bytes) -> None:
        """Append a message; never waits."""
        if len(message) > self._most:
            raise InvalidInputError(
                f"message: expected at most {self._most} bytes to send, got {len(message)}"
            )
        with self._changed:
            self._held.append(message)
            self._bytes += len(message)
            while self._bytes > self._most:
                self._bytes -= len(self._held.popleft())
                self.dropped += 1
            self._changed.notify()

    def next(self, timeout_s: float) -> bytes | None:
        """Take the oldest message, the one before being sent; None if none comes in time."""
        with self._changed:
            self._in_hand = 0
            if not self._changed.wait_for(lambda: bool(self._held), timeout_s):
                return None
            self._in_hand = 1
            message = self._held.popleft()
            self._bytes -= len(message)
            return message

    def clear(self) -> None:
        """Drop all."""
        with self._changed:
            self.dropped += len(self._held)
            self._held.clear()
            self._bytes = 0

    @property
    def waiting(self) -> int:
        """Messages not yet handed to the system as a whole."""
        return len(self._held) + self._in_hand


class Link:
    """A connected socket: what it brings goes into `inbox`, what is in `outbox` is sent.

    Parameters
    ----------
    ended : callable
        Called once with the reason when the peer is gone or makes no sense; not when closed from here.
    """

    def __init__(
        self,
        connected: socket.socket,
        inbox: Inbox,
        outbox: Outbox,
        limits: Limits,
        ended: Callable[[str], None],
    ) -> None:
        self._socket, self._inbox, self._outbox = connected, inbox, outbox
        self._limits, self._ended = limits, ended
        self._over, self._ending = threading.Event(), threading.Lock()
        connected.settimeout(_LOOK_S)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._read, self._write)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End both threads and the connection."""
        self._over.set()
        with suppress(OSError):  # the peer may be gone
            self._socket.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()
        self._socket.close()

    def _read(self) -> None:
        framing, heard_s = Framing(self._limits), time.monotonic()
        piece = bytearray(_PIECE_BYTES)
        try:
            while not self._over.is_set():
                try:
                    count = self._socket.recv_into(piece)
                except TimeoutError:
                    if framing.within_message and time.monotonic() - heard_s > self._limits.stall_s:
                        raise LostError(
                            f"expected the rest of a message, got none for {self._limits.stall_s:g} s"
                        ) from None
                    continue
                if not count:
                    where = " within a message" if framing.within_message else ""
                    raise ConnectionError(f"closed by the peer{where}")
                self._inbox.heard()
                for found in framing.feed(memoryview(piece)[:count]):
                    if isinstance(found, MessageError):
                        self._inbox.refuse(found)
                    else:
                        self._inbox.put(found, self._over)
                heard_s = time.monotonic()  # also after a wait for room
        except LostError as error:
            self._inbox.refuse(error)
            self._end(error)
        except OSError as error:
            self._end(error)

    def _write(self) -> None:
        try:
            while not self._over.is_set():
                left = memoryview(self._outbox.next(_LOOK_S) or b"")
                while left and not self._over.is_set():
                    with suppress(TimeoutError):
                        left = left[self._socket.send(left) :]
        except OSError as error:
            self._end(error)

    def _end(self, error: Exception) -> None:
        with self._ending:
            if self._over.is_set():
                return
            self._over.set()
        self._ended(str(error))


def _size(message: Received) -> int:
    return _SMALL_BYTES + (message.pixels.nbytes if isinstance(message, ImageReceived) else 0)
