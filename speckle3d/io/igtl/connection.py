"""A client of an OpenIGTLink server, as PLUS's, that connects again when the server was lost."""

from __future__ import annotations

import socket
import threading
from typing import Self

from speckle3d.io.igtl.link import Inbox, Link, LinkState, Outbox
from speckle3d.io.igtl.messages import Received

_CONNECT_S = 5.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 2.0
"""Between two attempts; doubled from one to the next."""


class Connection:
    """Connects in a thread of its own, and again whenever the server was lost.

    Parameters
    ----------
    host : str
    port : int

    Examples
    --------
    >>> from speckle3d.io.igtl.messages import packed_transform
    >>> from speckle3d.io.igtl.server import Server
    >>> import numpy as np
    >>> with Server(0) as server, Connection("127.0.0.1", server.port) as connection:
    ...     _ = connection.wait_connected(5.0) and server.wait_connected(5.0)
    ...     server.send(packed_transform("ProbeToTracker", 12.5, np.eye(4)))
    ...     received = connection.receive(5.0)
    >>> received[0].device, received[0].time_s, received[0].valid
    ('ProbeToTracker', 12.5, True)
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._inbox, self._outbox = Inbox(), Outbox()
        self._over, self._lost, self._connected = (threading.Event() for _ in range(3))
        self._connections = 0
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; what was received and not taken can still be taken."""
        self._over.set()
        self._lost.set()
        if self._thread.is_alive():
            self._thread.join()

    def wait_connected(self, timeout_s: float) -> bool:
        """Wait for the server; whether it was found in time."""
        return self._connected.wait(timeout_s)

    def receive(self, timeout_s: float) -> list[Received]:
        """Take all messages in the order in which they came, waiting for the first one.

        Returns
        -------
        list
            Empty if none came in time.
        """
        return self._inbox.take(timeout_s)

    def send(self, message: bytes) -> None:
        """Send a packed message without waiting for the peer: of too many the oldest are dropped."""
        self._outbox.put(message)

    @property
    def state(self) -> LinkState:
        """What has happened so far."""
        return self._inbox.state(self._connected.is_set(), self._connections - 1, self._outbox.dropped)

    def _run(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._over.is_set():
            before = self._inbox.messages
            try:
                connected = socket.create_connection(self._address, timeout=_CONNECT_S)
            except (OSError, UnicodeError) as error:  # Unicode: a host that cannot be a name
                self._inbox.last_failure = str(error)
            else:
                self._listen(connected)
            # A server that closes at once is no better than none.
            pause_s = _FIRST_PAUSE_S if self._inbox.messages > before else min(2 * pause_s, _LONGEST_PAUSE_S)
            self._over.wait(pause_s)

    def _listen(self, connected: socket.socket) -> None:
        self._lost.clear()
        self._connections += 1
        self._connected.set()
        link = Link(connected, self._inbox, self._outbox, self._ended)
        while not (self._lost.wait(_FIRST_PAUSE_S) or self._over.is_set()):
            pass
        self._connected.clear()
        link.close()
        self._outbox.clear()

    def _ended(self, reason: str) -> None:
        self._inbox.last_failure = reason
        self._lost.set()
