"""The server of the app: on this machine alone, for whoever has the token, while someone looks."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from panel.io.application import build_applications
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.netutil import bind_sockets

from speckle3d.app.guard import LOOPBACK, Careful, Gate, Guard
from speckle3d.app.look import shell
from speckle3d.app.page import Page
from speckle3d.core.errors import FileError

UNSEEN_S = 600.0
"""Without a viewer for so long, the server ends."""

_LOOK_S = 1.0
_MOST_HEADER_BYTES = 32 * 1024
_MOST_BODY_BYTES = 1024
"""Of requests, none of which has a body."""

_MOST_MESSAGE_BYTES = 4 * 2**20
"""Of what a page sends: a drawn outline of a hundred thousand corners."""


class AppServer:
    """Serve pages until nobody looks any more.

    Parameters
    ----------
    pages : sequence of Page
        Shared by all viewers; each is shown views of their own.
    title : str
        Name of what is looked at.
    port : int
        0 for any that is free.
    unseen_s : float
        Time without a viewer after which the server ends.

    Raises
    ------
    FileError
        If the port is taken.
    """

    def __init__(self, pages: Sequence[Page], title: str, port: int = 0, unseen_s: float = UNSEEN_S) -> None:
        self._unseen_s, self._seen_s = unseen_s, time.monotonic()
        self._sessions: set[str] = set()
        self._guard = Guard()
        try:
            sockets = bind_sockets(port, LOOPBACK)
        except OSError as error:
            raise FileError(f"port {port}: expected a free one: {error.strerror or error}") from error
        self._port: int = sockets[0].getsockname()[1]
        application = BokehTornado(
            build_applications(lambda: shell(pages, title), title=f"{title} - speckle3d"),
            # The gate looks at origins, by the name that was asked for.
            extra_websocket_origins=["*"],
            secret_key=self._guard.secret_key,
            sign_sessions=True,
            websocket_max_message_size_bytes=_MOST_MESSAGE_BYTES,
            # What is refused is told to who asked, not to the terminal.
            log_function=lambda _: None,
        )
        application.add_transform(Careful)
        http = HTTPServer(
            Gate(application, self._guard),
            max_header_size=_MOST_HEADER_BYTES,
            max_body_size=_MOST_BODY_BYTES,
            idle_connection_timeout=60.0,
        )
        http.add_sockets(sockets)
        self._server = BaseServer(IOLoop.current(), application, http)

    @property
    def address(self) -> str:
        """What to open in a browser, with the token."""
        return self._address(self._guard.token)

    def address_for_once(self) -> str:
        """Address that leads to `address` at its first use and nowhere after."""
        return self._address(self._guard.ticket())

    def _address(self, token: str) -> str:
        return f"http://{LOOPBACK}:{self._port}/?token={token}"

    def run(self) -> None:
        """Serve until nobody has looked for a while, or the process is told to end."""
        # A viewer may leave at any moment.
        logging.getLogger("bokeh.server.views.ws").addFilter(_is_no_farewell)
        self._server.start()
        looking = PeriodicCallback(self._look, 1000.0 * _LOOK_S)
        looking.start()
        try:
            self._server.io_loop.start()
        finally:
            looking.stop()
            self._server.stop(wait=False)

    def _look(self) -> None:
        now, before = time.monotonic(), self._sessions
        sessions = self._server.get_sessions()
        self._sessions = {session.id for session in sessions}
        # A page that was sent a moment ago has no connection yet.
        if self._sessions - before or any(session.connection_count for session in sessions):
            self._seen_s = now
        elif now - self._seen_s > self._unseen_s:
            self._server.io_loop.stop()


def _is_no_farewell(record: logging.LogRecord) -> bool:
    return "connection was closed" not in record.getMessage()
