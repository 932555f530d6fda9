"""Who may look: whoever has the token, from this machine, under this server's own address."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable
from typing import Any

from bokeh.server.auth_provider import AuthProvider
from tornado.web import HTTPError, RequestHandler

LOOPBACK = "127.0.0.1"


class Guard(AuthProvider):
    """Let in requests with the token in their address or, after the first, in their cookie.

    Attributes
    ----------
    token : str
        In the address that is opened.
    """

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(32)
        self.port: int | None = None
        super().__init__()

    @property
    def cookie(self) -> str:
        """Name of the cookie; browsers do not keep those of ports apart."""
        return f"speckle3d-{self.port}"

    @property
    def hosts(self) -> tuple[str, ...]:
        """Names under which this server is asked for."""
        return (f"{LOOPBACK}:{self.port}", f"localhost:{self.port}")

    @property
    def get_user(self) -> Callable[[Any], Any]:
        """Return what decides on a request, and raises HTTP's 403."""
        return self._admit

    @property
    def get_login_url(self) -> Callable[[Any], str]:
        """Return where others are sent, which is nowhere: `get_user` raises."""
        return lambda _: "/"

    def _admit(self, handler: RequestHandler) -> str:
        # A name of someone else's that leads here would make other people's pages ours (DNS rebinding).
        if handler.request.host not in self.hosts:
            raise HTTPError(403, reason="another host")
        given = handler.get_query_argument("token", None)
        if self._is_token(given):
            handler.set_cookie(self.cookie, self.token, httponly=True, samesite="Strict")
            return "viewer"
        if self._is_token(handler.get_cookie(self.cookie)):
            return "viewer"
        raise HTTPError(403, reason="no token")

    def _is_token(self, given: str | None) -> bool:
        return given is not None and hmac.compare_digest(given.encode(), self.token.encode())
