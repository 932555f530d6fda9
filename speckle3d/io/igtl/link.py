"""One socket to a peer, read and written by two threads, with bounded queues on either way."""

from __future__ import annotations

import queue
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from speckle3d.io.igtl.messages import HEADER, MessageError, Received, decode, read_header

_LOOK_S = 0.1
"""How often a waiting thread looks whether it is to end."""

STALL_S = 10.0
"""Longest pause within a message."""

_MOST_RECEIVED, _MOST_SENDING = 256, 64
"""Messages not yet taken, for which the peer then waits; and not yet sent, of which the oldest go."""


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
    """Messages received and not yet taken, and counts of what has come."""

    def __init__(self) -> None:
        self._queue: queue.Queue[Received] = queue.Queue(_MOST_RECEIVED)
        self.messages = self.refused = 0
        self.last_refused = self.last_failure = ""
        self.heard_s = time.monotonic()

    def put(self, message: Received, over: threading.Event) -> None:
        """Append a message as soon as there is room; not at all if its connection is over before."""
        while not over.is_set():
            with suppress(queue.Full):
                self._queue.put(message, timeout=_LOOK_S)
                self.messages += 1
                return

    def take(self, timeout_s: float) -> list[Received]:
        """Take all messages, waiting for the first one; none if none came in time."""
        taken: list[Received] = []
        with suppress(queue.Empty):
            taken.append(self._queue.get(timeout=timeout_s) if timeout_s > 0 else self._queue.get_nowait())
            while True:
                taken.append(self._queue.get_nowait())
        return taken

    def refuse(self, error: MessageError) -> None:
        """Count a message that made no sense."""
        self.refused += 1
        self.last_refused = str(error)

    def state(self, connected: bool, reconnections: int, dropped: int) -> LinkState:
        """What has happened so far."""
        return LinkState(
            connected, self.messages, self.refused, self.last_refused, max(reconnections, 0), dropped,
            self._queue.qsize(), time.monotonic() - self.heard_s, self.last_failure,
        )  # fmt: skip


class Outbox:
    """Messages to a peer that are not yet sent; of too many the oldest are dropped."""

    def __init__(self) -> None:
        self._queue: queue.Queue[bytes] = queue.Queue(_MOST_SENDING)
        self.dropped = 0

    def put(self, message: bytes) -> None:
        """Append a message; never waits."""
        while True:
            try:
                return self._queue.put_nowait(message)
            except queue.Full:
                self.clear(1)

    def clear(self, most: int = _MOST_SENDING) -> None:
        """Drop the oldest messages, as many at most."""
        with suppress(queue.Empty):
            for _ in range(most):
                self._queue.get_nowait()
                self._queue.task_done()
                self.dropped += 1

    def send_to(self, peer: socket.socket, over: threading.Event) -> None:
        """Send messages as they come until the connection is over."""
        while not over.is_set():
            try:
                left = memoryview(self._queue.get(timeout=_LOOK_S))
            except queue.Empty:
                continue
            try:
                while left and not over.is_set():
                    with suppress(TimeoutError):
                        left = left[peer.send(left) :]
            finally:
                self._queue.task_done()

    @property
    def waiting(self) -> int:
        """Messages not yet handed to the system as a whole."""
        return self._queue.unfinished_tasks


class Link:
    """A connected socket: what it brings goes into `inbox`, what is in `outbox` is sent.

    A message whose body makes no sense is refused alone. Where there is no header of a message, or the peer
    stalls within one, the connection is given up.

    Parameters
    ----------
    ended : callable
        Called once with the reason when the peer is gone or makes no sense; not when closed from here.
    """

    def __init__(
        self, connected: socket.socket, inbox: Inbox, outbox: Outbox, ended: Callable[[str], None]
    ) -> None:
        self._socket, self._inbox, self._outbox, self._ended = connected, inbox, outbox, ended
        self._over, self._ending = threading.Event(), threading.Lock()
        connected.settimeout(_LOOK_S)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._threads = [
            threading.Thread(target=self._guarded, args=(work,), daemon=True)
            for work in (self._read, lambda: outbox.send_to(connected, self._over))
        ]
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

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except (OSError, MessageError) as error:
            with self._ending:
                if self._over.is_set():
                    return
                self._over.set()
            self._ended(str(error))

    def _read(self) -> None:
        while not self._over.is_set():
            start = self._receive(HEADER.size, is_start=True)
            try:
                header = read_header(start)
            except MessageError as error:
                self._inbox.refuse(error)
                raise
            body = self._receive(header.body_bytes)
            try:
                message = decode(header, body)
            except MessageError as error:
                self._inbox.refuse(error)
            else:
                self._inbox.put(message, self._over)

    def _receive(self, count: int, is_start: bool = False) -> bytes:
        """Receive so many bytes; a message may begin after any time, and then has no long pause."""
        content, begun_s = bytearray(count), time.monotonic()
        left = memoryview(content)
        while left:
            is_within = not is_start or len(left) < count
            try:
                came = self._socket.recv_into(left)
            except TimeoutError:
                if self._over.is_set():
                    raise ConnectionError("closed") from None
                if is_within and time.monotonic() - begun_s > STALL_S:
                    raise ConnectionError(
                        f"expected the rest of a message, got none for {STALL_S:g} s"
                    ) from None
                continue
            if not came:
                raise ConnectionError(f"closed by the peer{' within a message' if is_within else ''}")
            left, begun_s = left[came:], time.monotonic()
            self._inbox.heard_s = begun_s
        return bytes(content)
