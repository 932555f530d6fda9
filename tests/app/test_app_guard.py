"""Who may look, and where may be written: decided without a server."""

import os
import re

import pytest
from bokeh.util.token import generate_jwt_token, generate_session_id
from tornado.httputil import HTTPHeaders, RequestStartLine

from speckle3d.app.folder import Folder
from speckle3d.app.guard import Guard
from speckle3d.core.errors import FileError, InvalidInputError


@pytest.fixture
def guard():
    return Guard()


def answer(guard, path, method="GET", host="127.0.0.1:4000", **headers):
    given = HTTPHeaders({"Host": host, **{name.replace("_", "-"): value for name, value in headers.items()}})
    return guard.answer(RequestStartLine(method, path, "HTTP/1.1"), given)


def with_token(guard):
    return f"/?token={guard.token}"


class TestPage:
    def test_opens_with_the_token_alone(self, guard):
        assert answer(guard, with_token(guard)) is None
        for path in ("/", "/?token=", "/?token=wrong", f"/?tokens={guard.token}", f"/{guard.token}"):
            assert answer(guard, path)[0] in (403, 404), path

    def test_a_ticket_leads_to_it_once(self, guard):
        ticket = guard.ticket()
        assert ticket != guard.token
        assert answer(guard, f"/?token={ticket}") == (302, with_token(guard))
        assert answer(guard, f"/?token={ticket}")[0] == 403

    @pytest.mark.parametrize(
        "host",
        [
            "example.org",
            "example.org:4000",
            "127.0.0.1.example.org:4000",
            "localhost.example.org",
            "",
            "[::1",
        ],
    )
    def test_another_name_that_leads_here_is_refused(self, guard, host):
        assert answer(guard, with_token(guard), host=host)[0] == 403

    @pytest.mark.parametrize("host", ["localhost:4000", "127.0.0.1:9", "localhost"])
    def test_a_tunnel_may_begin_at_another_port(self, guard, host):
        assert answer(guard, with_token(guard), host=host) is None

    @pytest.mark.parametrize(
        "origin", ["http://example.org", "http://127.0.0.1:4001", "https://127.0.0.1:4000", "null", "file://"]
    )
    def test_pages_of_others_are_refused_also_those_of_another_port(self, guard, origin):
        assert answer(guard, with_token(guard), Origin=origin)[0] == 403
        assert answer(guard, with_token(guard), Origin="http://127.0.0.1:4000") is None

    @pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH", "CONNECT"])
    def test_nothing_but_reading_is_allowed(self, guard, method):
        assert answer(guard, with_token(guard), method=method)[0] == 405


class TestOtherPaths:
    @pytest.mark.parametrize(
        "path",
        [
            "/autoload.js",
            "/metadata",
            "/admin",
            "/static/",
            "/static/js",
            "/static/js/",
            "/rest",
            "/liveness",
            "//",
        ],
    )
    def test_there_are_none_even_with_the_token(self, guard, path):
        assert answer(guard, f"{path}?token={guard.token}")[0] == 404

    @pytest.mark.parametrize(
        "path",
        ["/static/../../etc/passwd.js", "/static/%2e%2e/%2e%2e/secret.js", "/static/js/..%2f..%2fa.js"],
    )
    def test_scripts_lie_in_their_folder(self, guard, path):
        assert answer(guard, path)[0] == 404
        assert answer(guard, "/static/js/bokeh.min.js") is None

    def test_a_websocket_needs_a_session_that_this_server_signed(self, guard):
        def asked(token):
            return answer(guard, "/ws", Upgrade="websocket", Sec_WebSocket_Protocol=f"bokeh, {token}")

        def signed(key):
            return generate_jwt_token(generate_session_id(key, signed=True), secret_key=key, signed=True)

        assert asked(signed(guard.secret_key)) is None
        assert asked(signed(Guard().secret_key))[0] == 403
        assert asked("nonsense")[0] == 403
        assert asked(guard.token)[0] == 403
        assert answer(guard, "/ws", Upgrade="websocket")[0] == 403
        assert answer(guard, with_token(guard), Upgrade="websocket")[0] == 404

    @pytest.mark.parametrize(
        "token", ["", ".", "a.b", "a.b.c", "\u00fc", "A" * 9000, "e30.e30", "=.=", "%00"]
    )
    def test_a_session_of_nonsense_is_refused_not_answered_with_an_error(self, guard, token):
        headers = {"Upgrade": "websocket", "Sec_WebSocket_Protocol": f"bokeh, {token}"}
        assert answer(guard, "/ws", **headers)[0] == 403


class TestFolder:
    @pytest.fixture
    def folder(self, tmp_path):
        (tmp_path / "sweep.h5").write_bytes(b"sweep")
        return Folder(tmp_path / "sweep.h5")

    @pytest.mark.parametrize(
        "name",
        ["", " ", ".", "..", "../a.csv", "/x/a.csv", "a/b.csv", "a\\b.csv", ".hidden", "a\0.csv", "C:a.csv",
         "a\n.csv", "a.", "x" * 201, "\u00fc" * 101],
    )  # fmt: skip
    def test_only_a_name_in_it_is_taken(self, folder, name):
        with pytest.raises(InvalidInputError, match="expected"):
            folder.place(name)

    def test_nothing_is_written_over_nor_through_a_link(self, folder, tmp_path):
        os.symlink(tmp_path.parent / "elsewhere.csv", tmp_path / "link.csv")
        for name in ("sweep.h5", "link.csv"):
            with pytest.raises(InvalidInputError, match=re.escape(name)):
                folder.save(name, lambda path: path.write_text("new"))
        assert (tmp_path / "sweep.h5").read_bytes() == b"sweep"
        assert not (tmp_path.parent / "elsewhere.csv").exists()

    def test_a_file_appears_whole_or_not_at_all(self, folder, tmp_path):
        assert folder.save("points.csv", lambda path: path.write_text("1,2")).read_text() == "1,2"

        def breaks(path):
            path.write_text("1,")
            raise FileError("no")

        with pytest.raises(FileError):
            folder.save("more.csv", breaks)
        assert sorted(each.name for each in tmp_path.iterdir()) == ["points.csv", "sweep.h5"]
