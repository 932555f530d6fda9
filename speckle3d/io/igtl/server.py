"""An OpenIGTLink server, to which Slicer and others connect."""

from __future__ import annotations

import socket
import time
from contextlib import suppress

from speckle3d.core.errors import FileError
from speckle3d.io.igtl.link import End

DEFAULT_PORT = 18944
"""Registered for OpenIGTLink."""

_LOOK_S = 0.1


class Server(End):
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
        super().__init__()
        try:
            self._socket = socket.create_server((address, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise FileError(f"{address}:{port}: expected a free port to listen on: {reason}") from error
        self._socket.settimeout(_LOOK_S)
        self.port = int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Leave all clients and the port."""
        super().close()
        self._socket.close()

    def drain(self, timeout_s: float) -> bool:
        """Wait until all clients were sent everything; whether they were in time."""
        end_s = time.monotonic() + timeout_s
        while any(link.is_sending for link in list(self._links)):
            if time.monotonic() > end_s:
                return False
            time.sleep(_LOOK_S / 10)
        return True

    @property
    def clients(self) -> int:
        """How many are connected."""
        return len(self._links)

    def _run(self) -> None:
        while not self._over.is_set():
            self._close_lost()
            with suppress(TimeoutError, ConnectionError):  # a client that was gone before it was accepted
                self._add(self._socket.accept()[0])
