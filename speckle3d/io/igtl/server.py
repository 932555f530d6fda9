"""An OpenIGTLink server, to which Slicer and others connect."""

from __future__ import annotations

import socket
import threading
import time
from dataclasses import replace
from functools import partial
from typing import Self

from speckle3d.core.errors import FileError
from speckle3d.io.igtl.link import Inbox, Link, LinkState, Outbox
from speckle3d.io.igtl.messages import Limits, Received

DEFAULT_PORT = 18944
"""Registered for OpenIGTLink."""

_MOST_CLIENTS = 16
_LOOK_S = 0.1


class Server:
    """Sends every message to all its clients, and receives what they send.

    Parameters
    ----------
    port : int
        0 for any free one, which `port` then tells.
    address : str
        This machine alone by default.
    limits : Limits, optional
        `max_waiting_bytes` of all clients together, the others of each.

    Raises
    ------
    FileError
        If the port is taken, or not for this user.
    """

    def __init__(self, port: int, address: str = "127.0.0.1", limits: Limits | None = None) -> None:
        self._limits = limits or Limits()
        try:
            self._socket = socket.create_server((address, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise FileError(f"{address}:{port}: expected a free port to listen on: {reason}") from error
        self._socket.settimeout(_LOOK_S)
        self.port = int(self._socket.getsockname()[1])
        self._inbox = Inbox(self._limits)
        self._clients: dict[Link, Outbox] = {}
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
            links, self._clients = [*self._clients, *self._gone], {}
        for link in links:
            link.close()
        self._inbox.close()

    def wait_connected(self, timeout_s: float) -> bool:
        """Wait for a client; whether there is one."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._clients), timeout_s)

    def receive(self, timeout_s: float) -> list[Received]:
        """Take all messages of all clients, waiting for the first one; empty if none came in time."""
        return self._inbox.take(timeout_s)

    def send(self, message: bytes) -> None:
        """Send a packed message to all clients, without waiting for any: a slow one loses the oldest ones."""
        with self._changed:
            outboxes = list(self._clients.values())
        for outbox in outboxes:
            outbox.put(message)

    def drain(self, timeout_s: float) -> bool:
        """Wait until all clients were sent everything; whether they were in time."""
        end_s = time.monotonic() + timeout_s
        while any(outbox.waiting for outbox in list(self._clients.values())):
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
        with self._changed:
            dropped = self._dropped + sum(outbox.dropped for outbox in self._clients.values())
            reconnections = max(self._accepted - 1, 0)
        return replace(self._inbox.state(), dropped=dropped, reconnections=reconnections)

    def _run(self) -> None:
        while not self._over.is_set():
            self._bury()
            try:
                connected, _ = self._socket.accept()
            except TimeoutError:
                continue
            except OSError:  # a client that was gone before it was accepted
                self._over.wait(_LOOK_S)
                continue
            if len(self._clients) >= _MOST_CLIENTS:
                connected.close()
                continue
            self._accept(connected)

    def _accept(self, connected: socket.socket) -> None:
        outbox = Outbox(self._limits)
        with self._changed:
            # Made under the lock: a client that is gone at once is then known before it is removed.
            link: list[Link] = []
            link.append(Link(connected, self._inbox, outbox, self._limits, partial(self._lost, link)))
            self._clients[link[0]] = outbox
            self._accepted += 1
            self._changed.notify_all()
        self._inbox.note(True)

    def _lost(self, link: list[Link], reason: str) -> None:
        with self._changed:
            outbox = self._clients.pop(link[0], None)
            if outbox is not None:
                outbox.clear()
                self._dropped += outbox.dropped
                self._gone.append(link[0])
            left = bool(self._clients)
        self._inbox.note(left, reason)

    def _bury(self) -> None:
        """Close what belonged to clients that are gone; not in their own threads."""
        with self._changed:
            gone, self._gone = self._gone, []
        for link in gone:
            link.close()
