"""Who may look: whoever has the token, under a name of this machine, from a page of this server's own."""

from __future__ import annotations

import hmac
import re
import secrets
from collections.abc import Awaitable, Callable, Mapping
from urllib.parse import parse_qs, unquote, urlsplit

from bokeh.util.token import check_token_signature
from tornado.httputil import (
    HTTPConnection,
    HTTPHeaders,
    HTTPMessageDelegate,
    HTTPServerConnectionDelegate,
    RequestStartLine,
    ResponseStartLine,
)
from tornado.web import OutputTransform

LOOPBACK = "127.0.0.1"

_OUR_NAMES = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?", re.ASCII)
"""Hosts a browser may ask for; any port, for a tunnel may begin at another."""

_OPEN = re.compile(
    r"/favicon\.ico|/static/[\w./@%+-]*\.(js|css|map|svg|png|ico|woff2?|ttf|json|mjs)", re.ASCII
)
"""Scripts and styles that everyone has who has Panel."""

_WEBSOCKET = "bokeh"

_POLICY = "; ".join(
    [
        "default-src 'self'",
        # Bokeh and Panel make functions of text, and begin in a script within the page.
        "script-src 'self' blob: 'unsafe-inline' 'unsafe-eval'",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "font-src 'self' data:",
        "worker-src 'self' blob:",
        "connect-src 'self' ws://{host} data: blob:",
        "object-src 'none'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    ]
)

_ALWAYS = {
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Guard:
    """What decides on every request before anything else sees it.

    The page itself needs the token, and its websocket the signature of `secret_key`, which only the page has.
    There is no cookie: browsers send those to every port of this machine, other users' too.

    Attributes
    ----------
    token : str
        In the address that is opened.
    secret_key : bytes
        Signs the sessions.
    """

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(32)
        self.secret_key = secrets.token_bytes(32)
        self._tickets: set[str] = set()

    def ticket(self) -> str:
        """Token for one request alone, which is sent on to the real one.

        A browser is started with its address as an argument, and other users see arguments.
        """
        made = secrets.token_urlsafe(32)
        self._tickets.add(made)
        return made

    def answer(self, line: RequestStartLine, headers: HTTPHeaders) -> tuple[int, str] | None:
        """HTTP status and words of a request that is not let in; None for those that are.

        Of a ticket, the words are the address to go to.
        """
        address = urlsplit(line.path)
        host, given = headers.get("Host", ""), parse_qs(address.query).get("token", [""])[-1]
        if line.method not in ("GET", "HEAD"):
            return 405, "expected GET"
        # A name of someone else's that leads here would make other people's pages ours (DNS rebinding).
        if _OUR_NAMES.fullmatch(host) is None:
            return 403, "expected a name of this machine in the address"
        if headers.get("Origin", f"http://{host}") != f"http://{host}":
            return 403, "expected no page of another server to ask"
        if address.path == "/" and "Upgrade" not in headers:
            if self._used(given):
                return 302, f"/?token={self.token}"
            return None if _same(given, self.token) else (403, "expected the token of the printed address")
        if address.path == "/ws":
            return None if self._has_session(headers) else (403, "expected a session of a page")
        known = _OPEN.fullmatch(address.path) and ".." not in unquote(address.path)
        return None if known else (404, "nothing here")

    def _used(self, ticket: str) -> bool:
        found = next((each for each in self._tickets if _same(ticket, each)), None)
        self._tickets.discard(found or "")
        return found is not None

    def _has_session(self, headers: HTTPHeaders) -> bool:
        protocols = [each.strip() for each in headers.get("Sec-WebSocket-Protocol", "").split(",")]
        if len(protocols) != 2 or protocols[0] != _WEBSOCKET:
            return False
        try:
            return bool(check_token_signature(protocols[1], secret_key=self.secret_key, signed=True))
        except (ValueError, KeyError, TypeError, AttributeError):  # it decodes before it has checked
            return False


def _same(given: str, right: str) -> bool:
    return hmac.compare_digest(given.encode(errors="replace"), right.encode())


class Gate(HTTPServerConnectionDelegate):
    """Hand on to an application only the requests that a guard lets in."""

    def __init__(self, application: HTTPServerConnectionDelegate, guard: Guard) -> None:
        self._application, self._guard = application, guard

    def start_request(self, server_conn: object, request_conn: HTTPConnection) -> HTTPMessageDelegate:
        """Return what receives one request."""
        return _Request(
            self._guard, request_conn, lambda: self._application.start_request(server_conn, request_conn)
        )


class _Request(HTTPMessageDelegate):
    """A request, kept from the application until its headers are known."""

    def __init__(
        self, guard: Guard, connection: HTTPConnection, begin: Callable[[], HTTPMessageDelegate]
    ) -> None:
        self._guard, self._connection, self._begin = guard, connection, begin
        self._inner: HTTPMessageDelegate | None = None
        self._refusal: tuple[int, str] | None = None

    def headers_received(
        self, start_line: RequestStartLine | ResponseStartLine, headers: HTTPHeaders
    ) -> Awaitable[None] | None:
        assert isinstance(start_line, RequestStartLine)  # of a server
        self._refusal = self._guard.answer(start_line, headers)
        if self._refusal is None:
            self._inner = self._begin()
            return self._inner.headers_received(start_line, headers)
        return None

    def data_received(self, chunk: bytes) -> Awaitable[None] | None:
        return None if self._inner is None else self._inner.data_received(chunk)

    def finish(self) -> None:
        if self._inner is not None:
            self._inner.finish()
        elif self._refusal is not None:
            self._refuse(*self._refusal)

    def on_connection_close(self) -> None:
        if self._inner is not None:
            self._inner.on_connection_close()

    def _refuse(self, status: int, words: str) -> None:
        body = b"" if status == 302 else f"{status}: {words}\n".encode()
        headers = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), **_ALWAYS}
        if status == 302:
            headers |= {"Location": words, "Cache-Control": "no-store"}
        self._connection.write_headers(ResponseStartLine("HTTP/1.1", status, ""), HTTPHeaders(headers), body)
        self._connection.finish()


class Careful(OutputTransform):
    """Headers of every answer: nothing from other hosts, no address told to them, in no other's frame."""

    def __init__(self, request: object) -> None:
        self._host = request.headers.get("Host", LOOPBACK)  # type: ignore[attr-defined]

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Add the headers to an answer's first part."""
        more: Mapping[str, str] = {**_ALWAYS, "Content-Security-Policy": _POLICY.format(host=self._host)}
        for name, value in more.items():
            headers[name] = value
        return status_code, headers, chunk
