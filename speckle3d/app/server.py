"""The server of the app: on this machine alone, for whoever has its signed address, while someone looks."""

import logging
import secrets
import time
from collections.abc import Sequence

from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.util.token import generate_session_id
from panel.io.application import build_applications
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.netutil import bind_sockets
from tornado.web import HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError

from speckle3d.app.look import Page, shell
from speckle3d.core.errors import FileError

LOOPBACK = "127.0.0.1"
UNSEEN_S = 600.0
"""Without a viewer for so long, the server ends."""

_LOOK_S = 1.0
_SLOWEST_MS = 60_000
"""A browser may take so long to show a page. Bokeh waits for 15 s, then makes the session anew, whose styles
Panel takes from the network."""


class AppServer:
    """Serve pages until nobody looks any more.

    Bokeh serves a session alone whose identity is signed: the page and its websocket answer 403 without, and
    to pages of other origins. There is no cookie: browsers send those to every port of this machine.

    Parameters
    ----------
    pages : sequence of Page
        Shared by all viewers.
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
        self.unseen_s, self._seen_s = unseen_s, time.monotonic()
        self._sessions: set[str] = set()
        try:
            sockets = bind_sockets(port, LOOPBACK)
        except OSError as error:
            raise FileError(f"port {port}: expected a free one: {error.strerror or error}") from error
        own_port = sockets[0].getsockname()[1]
        self._origin = f"http://{LOOPBACK}:{own_port}"
        key = secrets.token_bytes(32)
        self.address = f"{self._origin}/?bokeh-session-id={generate_session_id(key, signed=True)}"
        self._tickets: dict[str, str] = {}
        application = BokehTornado(
            build_applications(lambda: shell(pages, title), title=f"{title} - speckle3d"),
            extra_websocket_origins=[f"{host}:{own_port}" for host in (LOOPBACK, "localhost")],
            extra_patterns=[(r"/once/([\w-]+)", _Once, {"addresses": self._tickets})],
            secret_key=key,
            sign_sessions=True,
            generate_session_ids=False,
            unused_session_lifetime_milliseconds=_SLOWEST_MS,
            # What is refused is told to who asked, not to the terminal.
            log_function=lambda _: None,
        )
        http = HTTPServer(application)
        http.add_sockets(sockets)
        self._server = BaseServer(IOLoop.current(), application, http)

    def address_for_once(self) -> str:
        """Address that leads to `address` at its first use and nowhere after.

        A browser is started with its address as an argument, and other users see arguments.
        """
        ticket = secrets.token_urlsafe(32)
        self._tickets[ticket] = self.address.removeprefix(self._origin)
        return f"{self._origin}/once/{ticket}"

    def run(self) -> None:
        """Serve until nobody has looked for a while, or the process is told to end."""
        # A viewer may leave at any moment.
        for name in ("asyncio", "bokeh.server.views.ws"):
            logging.getLogger(name).addFilter(_is_no_farewell)
        self._server.start()
        looking = PeriodicCallback(self._look, 1000.0 * _LOOK_S)
        looking.start()
        try:
            self._server.io_loop.start()
        finally:
            looking.stop()
            self._server.stop(wait=False)

    def end(self) -> None:
        """End `run`, from any thread."""
        self._server.io_loop.add_callback(self._server.io_loop.stop)

    def _look(self) -> None:
        now_s, before = time.monotonic(), self._sessions
        sessions = self._server.get_sessions()
        self._sessions = {session.id for session in sessions}
        # A page that was sent a moment ago has no connection yet.
        if self._sessions - before or any(session.connection_count for session in sessions):
            self._seen_s = now_s
        elif now_s - self._seen_s > self.unseen_s:
            self._server.io_loop.stop()


class _Once(RequestHandler):
    """Send on to an address whoever has its ticket first."""

    def initialize(self, addresses: dict[str, str]) -> None:
        self._addresses = addresses

    def get(self, ticket: str) -> None:
        if ticket not in self._addresses:
            raise HTTPError(403)
        self.redirect(self._addresses.pop(ticket))


def _is_no_farewell(record: logging.LogRecord) -> bool:
    is_closed = record.exc_info is not None and isinstance(record.exc_info[1], WebSocketClosedError)
    return not is_closed and "connection was closed" not in record.getMessage()
