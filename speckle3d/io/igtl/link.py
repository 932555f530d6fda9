"""One socket to a peer, read and written by two threads, and what client and server have in common."""

from __future__ import annotations

import queue
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Self

from speckle3d.io.igtl.messages import HEADER, MessageError, Received, body_bytes, decode

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
    silent_s: float = 0.0
    last_failure: str = ""


class End:
    """An end of connections: messages received and not yet taken, and counts of what has come.

    A thread of its own makes connections; each has two more.
    """

    def __init__(self) -> None:
        self._inbox: queue.Queue[Received] = queue.Queue(_MOST_RECEIVED)
        self._links: list[Link] = []
        self._lost: list[Link] = []
        self._changed, self._over = threading.Condition(), threading.Event()
        self._made = self._dropped = self.messages = self.refused = 0
        self.last_refused = self.last_failure = ""
        self.heard_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all connections; what was received and not taken can still be taken."""
        self._over.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join()
        with self._changed:
            self._lost, self._links = self._lost + self._links, []
        self._close_lost()

    def wait_connected(self, timeout_s: float) -> bool:
        """Wait for a peer; whether there is one."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._links), timeout_s)

    def receive(self, timeout_s: float) -> list[Received]:
        """Take all messages in the order in which they came, waiting for the first one.

        Returns
        -------
        list
            Empty if none came in time.
        """
        taken: list[Received] = []
        with suppress(queue.Empty):
            taken.append(self._inbox.get(timeout_s > 0, timeout_s))
            while True:
                taken.append(self._inbox.get_nowait())
        return taken

    def send(self, message: bytes) -> None:
        """Send a packed message to all peers, without waiting for any: a slow one loses the oldest ones."""
        for link in list(self._links):
            link.send(message)

    @property
    def state(self) -> LinkState:
        """What has happened so far."""
        dropped = self._dropped + sum(link.dropped for link in list(self._links))
        return LinkState(
            bool(self._links), self.messages, self.refused, self.last_refused, max(self._made - 1, 0),
            dropped, time.monotonic() - self.heard_s, self.last_failure,
        )  # fmt: skip

    def put(self, message: Received, over: threading.Event) -> None:
        """Take a message as soon as there is room; not at all if its connection is over before."""
        while not over.is_set():
            with suppress(queue.Full):
                self._inbox.put(message, timeout=_LOOK_S)
                self.messages += 1
                return

    def refuse(self, error: MessageError) -> None:
        """Count a message that made no sense."""
        self.refused += 1
        self.last_refused = str(error)

    def lose(self, link: Link, reason: str) -> None:
        """Give up a connection."""
        with self._changed:
            if link in self._links:
                self._links.remove(link)
                self._lost.append(link)
                self._dropped += link.dropped
                self.last_failure = reason
                self._changed.notify_all()

    def _add(self, connected: socket.socket) -> None:
        link = Link(connected, self)
        with self._changed:
            self._links.append(link)
            self._made += 1
            self._changed.notify_all()
        link.start()  # known before it can be lost

    def _close_lost(self) -> None:
        """End the threads of lost connections, which cannot do so themselves."""
        with self._changed:
            lost, self._lost = self._lost, []
        for link in lost:
            link.close()

    def _run(self) -> None:
        """Make connections until `_over` is set."""
        raise NotImplementedError


class Link:
    """A connected socket: what it brings goes to its end, messages to send wait in a queue.

    A message whose body makes no sense is refused alone. Where there is no header of a message, or the peer
    stalls within one, the connection is given up.
    """

    def __init__(self, connected: socket.socket, end: End) -> None:
        self._socket, self._end = connected, end
        self._outbox: deque[bytes] = deque(maxlen=_MOST_SENDING)
        self._changed, self._over, self._sends = threading.Condition(), threading.Event(), False
        self.dropped = 0
        connected.settimeout(_LOOK_S)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._threads = [
            threading.Thread(target=self._guarded, args=(work,), daemon=True)
            for work in (self._read, self._write)
        ]

    def start(self) -> None:
        """Begin to read and to send."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End both threads and the connection."""
        self._over.set()
        with suppress(OSError):  # the peer may be gone
            self._socket.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        self._socket.close()

    def send(self, message: bytes) -> None:
        """Append a message to those to send; never waits."""
        with self._changed:
            self.dropped += len(self._outbox) == self._outbox.maxlen
            self._outbox.append(message)
            self._changed.notify()

    @property
    def is_sending(self) -> bool:
        """Whether there are messages not yet handed to the system as a whole."""
        with self._changed:
            return self._sends or bool(self._outbox)

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except (OSError, MessageError) as error:
            if not self._over.is_set():
                self._over.set()
                self._end.lose(self, str(error))

    def _write(self) -> None:
        while not self._over.is_set():
            with self._changed:
                self._sends = self._changed.wait_for(lambda: bool(self._outbox), _LOOK_S)
                left = memoryview(self._outbox.popleft() if self._sends else b"")
            while left and not self._over.is_set():
                with suppress(TimeoutError):
                    left = left[self._socket.send(left) :]

    def _read(self) -> None:
        while not self._over.is_set():
            start = self._receive(HEADER.size, is_start=True)
            try:
                size = body_bytes(start)
            except MessageError as error:
                self._end.refuse(error)
                raise
            body = self._receive(size)
            try:
                self._end.put(decode(start, body), self._over)
            except MessageError as error:
                self._end.refuse(error)

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
            self._end.heard_s = begun_s
        return bytes(content)
