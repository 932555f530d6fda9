"""The app's server as a browser, and others, meet it."""

import http.client
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request

import pytest
from browsers import needs_browser, opened, running, viewing
from commands import command

pytestmark = needs_browser


@pytest.fixture(scope="module")
def address(shipped):
    with viewing(shipped / "phantom.h5") as address:
        yield address


def refused(address, method="GET", **headers):
    request = urllib.request.Request(address, headers=headers, method=method)
    with pytest.raises(urllib.error.HTTPError) as refusal:
        urllib.request.urlopen(request, timeout=20)
    with refusal.value as answer:
        return answer.code


def shaken(address, **headers):
    """Status with which a websocket is answered."""
    asked = {
        "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol": "bokeh, e30.nonsense",
    }  # fmt: skip
    connection = http.client.HTTPConnection(urllib.parse.urlsplit(address).netloc, timeout=20)
    try:
        connection.request("GET", "/ws", headers=asked | headers)
        return connection.getresponse().status
    finally:
        connection.close()


def test_it_opens_without_complaint_and_asks_nobody_else(browser, address):
    page = opened(browser, address)
    page.wait_for_selector("canvas")
    page.click("text=Sensor")
    page.wait_for_selector(".magnetometer")
    assert page.complaints == []
    own = address.split("?")[0]
    assert [each for each in page.requests if not each.startswith(own)] == []
    assert page.evaluate("document.documentElement.scrollWidth") <= 1366
    page.close()


def test_without_the_token_or_under_another_name_it_is_closed(address):
    bare = address.split("?")[0]
    assert refused(bare) == 403
    assert refused(f"{bare}?token=wrong") == 403
    assert refused(address, Host="example.org") == 403
    assert refused(address, Origin="http://example.org") == 403
    assert refused(address, method="POST") == 405
    assert refused(f"{bare}autoload.js?bokeh-autoload-element=1") == 404
    assert refused(f"{bare}static/js/") == 404
    assert shaken(address) == 403
    assert shaken(address, Origin="http://example.org") == 403


def test_what_it_answers_tells_other_hosts_nothing(address):
    with urllib.request.urlopen(address, timeout=20) as answer:
        assert answer.headers["Referrer-Policy"] == "no-referrer"
        policy = answer.headers["Content-Security-Policy"]
        assert "Set-Cookie" not in answer.headers
        assert "Access-Control-Allow-Origin" not in answer.headers
    named = set(re.findall(r"[a-z]+://\S+?(?=[;\s]|$)", policy))
    assert named == {address.split("/?")[0].replace("http", "ws")}
    assert "frame-ancestors 'none'" in policy


def test_a_page_of_another_server_cannot_show_or_ask_it(browser, address, tmp_path):
    (tmp_path / "other.html").write_text(f'<iframe src="{address}"></iframe>', encoding="utf-8")
    command = [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", tmp_path]
    with running(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        port = re.search(r"port (\d+)", server.stdout.readline())[1]
        page = opened(browser, f"http://127.0.0.1:{port}/other.html")
        socket = f"{address.split('?')[0]}ws".replace("http", "ws")
        answer = page.evaluate(
            "at => new Promise(done => { const s = new WebSocket(at, ['bokeh', 'x']);"
            "s.onopen = () => done('open'); s.onerror = () => done('refused') })",
            socket,
        )
        assert answer == "refused"
        with pytest.raises(Exception, match="Failed to fetch"):
            page.evaluate("at => fetch(at).then(answer => answer.text())", address)
        assert any("frame" in each or "403" in each for each in page.complaints)
        assert all(frame.url in ("", "chrome-error://chromewebdata/") for frame in page.frames[1:])
        page.close()


def test_it_ends_when_nobody_looks(browser, shipped):
    code = (
        "import sys; from pathlib import Path; from speckle3d.app.opened import pages_of; "
        "from speckle3d.app.server import AppServer; path = Path(sys.argv[1]); "
        "server = AppServer(pages_of(path), path.name, unseen_s=3.0); "
        "print(server.address_for_once(), flush=True); server.run()"
    )
    command = [sys.executable, "-c", code, shipped / "phantom.h5"]
    with running(command, stdout=subprocess.PIPE) as server:
        page = opened(browser, server.stdout.readline().strip())
        page.wait_for_selector("canvas")
        page.wait_for_timeout(5000)
        assert server.poll() is None  # while someone looks
        page.close()
        assert server.wait(15) == 0


def test_ctrl_c_ends_it_and_leaves_nothing(shipped, tmp_path):
    (tmp_path / "sweep.h5").symlink_to(shipped / "phantom.h5")
    view = command("view", "--no-browser", tmp_path / "sweep.h5")
    with running(view, stderr=subprocess.PIPE) as server:
        assert server.stderr.readline().startswith("http://127.0.0.1:")
        time.sleep(0.5)
        os.kill(server.pid, signal.SIGINT)
        assert server.stderr.read() == "speckle3d: stopped\n"
        assert server.wait(10) == 130
    assert [each.name for each in tmp_path.iterdir()] == ["sweep.h5"]
