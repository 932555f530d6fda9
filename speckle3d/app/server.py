"""The server of the app: on this machine alone, for whoever has the token, while someone looks."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import panel as pn
from bokeh.server.server import Server
from panel.viewable import Viewable

from speckle3d.app.guard import LOOPBACK, Guard
from speckle3d.app.page import Page

UNSEEN_S = 600.0
"""Without a viewer for so long, the server ends."""
_LOOK_S = 1.0


class AppServer:
    """Serve pages until nobody looks any more.

    Parameters
    ----------
    make : callable
        Makes the pages, for each viewer anew.
    port : int
        0 for any that is free.
    unseen_s : float
        Time without a viewer after which the server ends.
    """

    def __init__(
        self, make: Callable[[], Sequence[Page]], title: str, port: int = 0, unseen_s: float = UNSEEN_S
    ) -> None:
        self._guard = Guard()
        self._unseen_s, self._seen_s = unseen_s, time.monotonic()
        self._server: Server = pn.io.server.get_server(
            lambda: shell(make()),
            port=port,
            address=LOOPBACK,
            websocket_origin=[f"{LOOPBACK}:{port}"],
            title=title,
            auth_provider=self._guard,
        )
        self._guard.port = self._server.port
        # Known once a free port was found.
        self._server._tornado._websocket_origins = set(self._guard.hosts)

    @property
    def address(self) -> str:
        """What to open in a browser, with the token."""
        return f"http://{LOOPBACK}:{self._server.port}/?token={self._guard.token}"

    def run(self) -> None:
        """Serve until nobody has looked for a while, or the process is told to end."""
        from tornado.ioloop import PeriodicCallback

        self._server.start()
        looking = PeriodicCallback(self._look, 1000.0 * _LOOK_S)
        looking.start()
        try:
            self._server.io_loop.start()
        finally:
            looking.stop()
            self._server.stop()

    def _look(self) -> None:
        now = time.monotonic()
        if any(session.connection_count for session in self._server.get_sessions()):
            self._seen_s = now
        elif now - self._seen_s > self._unseen_s:
            self._server.io_loop.stop()


def shell(pages: Sequence[Page]) -> Viewable:
    """Pages as tabs; a single one without."""
    pn.extension()
    if len(pages) == 1:
        return pages[0].view()
    return pn.Tabs(*((page.title, page.view()) for page in pages), dynamic=True, sizing_mode="stretch_width")
