"""An OpenIGTLink server, to which Slicer and others connect."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from typing import Self

from speckle3d.core.errors import FileError
from speckle3d.io.igtl.link import Inbox, Link, LinkState, Outbox
from speckle3d.io.igtl.messages import Received

DEFAULT_PORT = 18944
"""Registered for OpenIGTLink."""

_LOOK_S = 0.1


class Server:
    """Sends every message to all its clients, and receives what they send.

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
        try:
            self._socket = socket.create_server((address, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise FileError(f"{address}:{port}: expected a free port to listen on: {reason}") from error
        self._socket.settimeout(_LOOK_S)
        self.port = int(self._socket.getsockname()[1])
        self._inbox = Inbox()
        self._clients: dict[Outbox, Link] = {}
        self._gone: list[Link] = []
        self._changed = threading.Condition()
        self._dropped = self._accepted = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave all clients and the port."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()
        self._socket.close()
        with self._changed:
            links, self._clients = [*self._clients.values(), *self._gone], {}
        for link in links:
            link.close()

    def wait_connected(self, timeout_s: float) -> bool:
        """Wait for a client; whether there is one."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._clients), timeout_s)

    def receive(self, timeout_s: float) -> list[Received]:
        """Take all messages of all clients, waiting for the first one; empty if none came in time."""
        return self._inbox.take(timeout_s)

    def send(self, message: bytes) -> None:
        """Send a packed message to all clients, without waiting for any: a slow one loses the oldest ones."""
        for outbox in list(self._clients):
            outbox.put(message)

    def drain(self, timeout_s: float) -> bool:
        """Wait until all clients were sent everything; whether they were in time."""
        end_s = time.monotonic() + timeout_s
        while any(outbox.waiting for outbox in list(self._clients)):
            if time.monotonic() > end_s:
                return False
            time.sleep(_LOOK_S / 10)
        return True

    @property
    def clients(self) -> int:
        """How many are connected."""
        return len(self._clients)

    @property
    def state(self) -> LinkState:
        """What has happened so far."""
        dropped = self._dropped + sum(outbox.dropped for outbox in list(self._clients))
        return self._inbox.state(bool(self._clients), self._accepted - 1, dropped)

    def _run(self) -> None:
        while not self._over.is_set():
            with self._changed:
                gone, self._gone = self._gone, []
            for link in gone:  # not in their own threads
                link.close()
            with suppress(TimeoutError, ConnectionError):  # a client that was gone before it was accepted
                self._accept(self._socket.accept()[0])

    def _accept(self, connected: socket.socket) -> None:
        outbox = Outbox()
        with self._changed:
            # Made under the lock: a client that is gone at once is then known before it is removed.
            self._clients[outbox] = Link(
                connected, self._inbox, outbox, lambda reason: self._lost(outbox, reason)
            )
            self._accepted += 1
            self._changed.notify_all()

    def _lost(self, outbox: Outbox, reason: str) -> None:
        with self._changed:
            link = self._clients.pop(outbox, None)
            if link is not None:
                outbox.clear()
                self._dropped += outbox.dropped
                self._gone.append(link)
        self._inbox.last_failure = reason
