"""A client of an OpenIGTLink server, as PLUS's, that connects again when the server was lost."""

from __future__ import annotations

import socket

from speckle3d.io.igtl.link import End

_CONNECT_S = 5.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 2.0
"""Between two attempts; doubled from one to the next."""


class Connection(End):
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
        super().__init__()
        self._address = (host, port)

    def _run(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._over.is_set():
            before = self.messages
            try:
                self._add(socket.create_connection(self._address, timeout=_CONNECT_S))
            except (OSError, UnicodeError) as error:  # Unicode: a host that cannot be a name
                self.last_failure = str(error)
            with self._changed:
                self._changed.wait_for(lambda: self._over.is_set() or not self._links)
            self._close_lost()
            # A server that closes at once is no better than none.
            pause_s = _FIRST_PAUSE_S if self.messages > before else min(2 * pause_s, _LONGEST_PAUSE_S)
            self._over.wait(pause_s)
