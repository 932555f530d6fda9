"""Both ends of OpenIGTLink's connections: a server for many clients, and a client that connects again.

Each end has one thread, which connects, reads and writes: nobody else waits for the network.
"""

from __future__ import annotations

import queue
import select
import socket
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

from speckle3d.core.errors import FileError
from speckle3d.io.igtl.messages import HEADER, MessageError, Received, body_bytes, decode

DEFAULT_PORT = 18944
"""Registered for OpenIGTLink."""

STALL_S = 10.0
"""Longest pause within a message."""

_LOOK_S, _FULL_S = 0.1, 0.005
"""Longest wait for the network, and where messages have to be taken first."""
_CONNECT_S = 5.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 2.0
"""Between two attempts to connect; doubled from one to the next."""
_MOST_RECEIVED, _MOST_SENDING = 256, 64
"""Messages not yet taken, for which the peer then waits; and not yet sent, of which the oldest go."""
_PIECE_BYTES = 2**20


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


class _Peer:
    """A connected socket: bytes of a message that is not whole yet, and messages to send."""

    def __init__(self, connected: socket.socket) -> None:
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.socket, self.heard_s = connected, time.monotonic()
        self.content, self.outbox, self.left = (
            bytearray(),
            deque[bytes](maxlen=_MOST_SENDING),
            memoryview(b""),
        )

    def fileno(self) -> int:
        """Of the socket, for `select`."""
        return self.socket.fileno()


class End:
    """An end of connections: messages received and not yet taken, and counts of what has come.

    A message whose body makes no sense is refused alone. Where there is no header of a message, or the peer
    stalls within one, the connection is given up.
    """

    def __init__(self) -> None:
        self._inbox: queue.Queue[Received] = queue.Queue(_MOST_RECEIVED)
        self._peers: list[_Peer] = []
        self._changed, self._over = threading.Condition(), threading.Event()
        self._woken, self._wake = socket.socketpair()
        self._made = self._dropped = self._messages = self._refused = 0
        self._last_refused = self._last_failure = ""
        self._heard_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all connections; what was received and not taken can still be taken."""
        self._over.set()
        with suppress(OSError):  # closed already
            self._wake.send(b"\0")
        if self._thread.is_alive():
            self._thread.join()
        for one in (*(peer.socket for peer in self._peers), self._wake, self._woken):
            one.close()
        self._peers = []

    def wait_connected(self, timeout_s: float) -> bool:
        """Wait for a peer; whether there is one."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._peers), timeout_s)

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
        for peer in list(self._peers):
            self._dropped += len(peer.outbox) == peer.outbox.maxlen
            peer.outbox.append(message)
        self._wake.send(b"\0")

    @property
    def state(self) -> LinkState:
        """What has happened so far."""
        return LinkState(
            bool(self._peers), self._messages, self._refused, self._last_refused, max(self._made - 1, 0),
            self._dropped, time.monotonic() - self._heard_s, self._last_failure,
        )  # fmt: skip

    def _connect(self) -> list[socket.socket]:
        """Make connections, if need be; returns sockets to look at beside those of peers."""
        raise NotImplementedError

    def _run(self) -> None:
        while not self._over.is_set():
            more, is_full = self._connect(), self._inbox.full()
            reading = [] if is_full else self._peers
            writing = [peer for peer in self._peers if peer.outbox or peer.left]
            wait_s = _FULL_S if is_full else _LOOK_S
            looked_at: list[Any] = [self._woken, *more, *reading]
            readable, writable, _ = select.select(looked_at, writing, [], wait_s)
            if self._woken in readable:
                self._woken.recv(_PIECE_BYTES)
            for peer in list(self._peers):
                try:
                    if peer in writable:
                        if not peer.left:
                            peer.left = memoryview(peer.outbox[0])  # never neither here nor there
                            peer.outbox.popleft()
                        peer.left = peer.left[peer.socket.send(peer.left) :]
                    if peer in readable:
                        self._read(peer)
                    elif peer.content and time.monotonic() - peer.heard_s > STALL_S:
                        raise ConnectionError(f"expected the rest of a message, got none for {STALL_S:g} s")
                except BlockingIOError:
                    pass
                except (OSError, MessageError) as error:
                    self._last_failure = str(error)
                    self._peers.remove(peer)
                    peer.socket.close()

    def _add(self, connected: socket.socket) -> None:
        with self._changed:
            self._peers.append(_Peer(connected))
            self._made += 1
            self._changed.notify_all()

    def _read(self, peer: _Peer) -> None:
        """Take what came, and of it the messages that are whole."""
        came = peer.socket.recv(_PIECE_BYTES)
        if not came:
            raise ConnectionError(f"closed by the peer{' within a message' if peer.content else ''}")
        peer.content += came
        self._heard_s = peer.heard_s = time.monotonic()
        while len(peer.content) >= HEADER.size and not self._over.is_set():
            start = bytes(peer.content[: HEADER.size])
            try:
                stop = HEADER.size + body_bytes(start)
            except MessageError as error:
                self._refuse(error)
                raise
            if len(peer.content) < stop:
                return
            body = bytes(peer.content[HEADER.size : stop])
            del peer.content[:stop]
            try:
                message = decode(start, body)
            except MessageError as error:
                self._refuse(error)
                continue
            while not self._over.is_set():
                with suppress(queue.Full):
                    self._inbox.put(message, timeout=_LOOK_S)
                    self._messages += 1
                    break

    def _refuse(self, error: MessageError) -> None:
        self._refused, self._last_refused = self._refused + 1, str(error)


class Connection(End):
    """A client of a server, as PLUS's, that connects again whenever the server was lost.

    Parameters
    ----------
    host : str
    port : int

    Examples
    --------
    >>> from speckle3d.io.igtl.messages import packed_transform
    >>> import numpy as np
    >>> with Server(0) as server, Connection("127.0.0.1", server.port) as connection:
    ...     _ = connection.wait_connected(5.0) and server.wait_connected(5.0)
    ...     server.send(packed_transform("ProbeToTracker", 12.5, np.eye(4)))
    ...     received = connection.receive(5.0)
    >>> received[0].device, received[0].time_s, received[0].valid
    ('ProbeToTracker', 12.5, True)
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__()
        self._address, self._pause_s, self._before = (host, port), 0.0, 0

    def _connect(self) -> list[socket.socket]:
        if self._peers or self._over.wait(self._pause_s):
            return []
        # A server that closes at once is no better than none.
        longer = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self._pause_s = max(_FIRST_PAUSE_S, longer if self._messages == self._before else 0.0)
        self._before = self._messages
        try:
            self._add(socket.create_connection(self._address, timeout=_CONNECT_S))
        except (OSError, UnicodeError) as error:  # Unicode: a host that cannot be a name
            self._last_failure = str(error)
        return []


class Server(End):
    """Sends every message to all its clients, as Slicer, and receives what they send.

    Parameters
    ----------
    port : int
        0 for any free one, which `port` then tells.
    address : str
        This machine alone by default.

    Raises
    ------
    FileError
        If the port is taken, or not for this user.
    """

    def __init__(self, port: int, address: str = "127.0.0.1") -> None:
        super().__init__()
        try:
            self._socket = socket.create_server((address, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise FileError(f"{address}:{port}: expected a free port to listen on: {reason}") from error
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Leave all clients and the port."""
        super().close()
        self._socket.close()

    def drain(self, timeout_s: float) -> bool:
        """Wait until all clients were sent everything; whether they were in time."""
        end_s = time.monotonic() + timeout_s
        while any(peer.outbox or peer.left for peer in list(self._peers)):
            if time.monotonic() > end_s:
                return False
            time.sleep(_LOOK_S / 10)
        return True

    @property
    def clients(self) -> int:
        """How many are connected."""
        return len(self._peers)

    def _connect(self) -> list[socket.socket]:
        with suppress(OSError):  # there is none, or it was gone before it was accepted
            self._add(self._socket.accept()[0])
        return [self._socket]
