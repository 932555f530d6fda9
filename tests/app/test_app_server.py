"""The app's server as a browser, and others, meet it."""

import re
import subprocess
import sys
import urllib.error
import urllib.request

import pytest
from bokeh.util.token import generate_session_id
from browsers import LIMIT_S, needs_browser, open_page, running, viewing

pytestmark = needs_browser


@pytest.fixture(scope="module")
def address(data_folder):
    with viewing(data_folder / "phantom.h5") as address:
        yield address


def status(address, **headers):
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=LIMIT_S) as answer:
            assert "Set-Cookie" not in answer.headers
            return answer.status
    except urllib.error.HTTPError as refusal:
        with refusal:
            return refusal.code


def test_it_opens_without_complaint_and_asks_nobody_else(browser, address):
    page = open_page(browser, address)
    page.wait_for_selector("canvas")
    page.click("text=Sensor")
    page.wait_for_selector(".magnetometer")
    assert page.complaints == []
    origin = address.split("?")[0]
    assert [url for url in page.requests if not url.startswith(origin)] == []
    assert page.evaluate("document.documentElement.scrollWidth") <= 1366
    page.close()


def test_without_its_signature_an_address_is_refused(address):
    bare, _, signature = address.partition("?bokeh-session-id=")
    forgery = generate_session_id(b"another key" * 4, signed=True)
    assert status(address) == 200
    assert status(bare) == 403
    assert status(f"{bare}?bokeh-session-id={forgery}") == 403
    assert status(f"{bare}?bokeh-session-id={signature[:-3]}abc") == 403
    assert status(f"{bare}autoload.js?bokeh-autoload-element=1") == 403


def test_the_address_that_a_browser_is_started_with_opens_once(browser, data_folder):
    """Other users see the arguments that programs are started with."""
    code = (
        "import sys; from pathlib import Path; from threading import Thread; "
        "from speckle3d.app.opened import pages_of; from speckle3d.app.server import AppServer; "
        "path = Path(sys.argv[1]); server = AppServer(pages_of(path), path.name); "
        "limit_s = lambda: float(sys.stdin.readline()); "
        "Thread(target=lambda: setattr(server, 'unseen_s', limit_s()), daemon=True).start(); "
        "print(server.address_for_once(), flush=True); server.run()"
    )
    command = [sys.executable, "-c", code, data_folder / "phantom.h5"]
    with running(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:
        once = server.stdout.readline().strip()
        page = open_page(browser, once)
        page.wait_for_selector("canvas")
        assert "bokeh-session-id" in page.url
        assert status(once) == 403
        server.stdin.write("2\n")
        server.stdin.flush()
        page.wait_for_timeout(5000)
        assert server.poll() is None  # while someone looks
        page.close()
        assert server.wait(LIMIT_S) == 0  # and ends when nobody does


def test_a_page_of_another_server_cannot_ask_it(browser, address, tmp_path):
    (tmp_path / "other.html").write_text("<p>other</p>", encoding="utf-8")
    command = [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", tmp_path]
    with running(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        port = re.search(r"port (\d+)", server.stdout.readline())[1]
        page = open_page(browser, f"http://127.0.0.1:{port}/other.html")
        socket = f"{address.split('?')[0]}ws".replace("http", "ws")
        answer = page.evaluate(
            "at => new Promise(done => { const s = new WebSocket(at, ['bokeh', 'x']);"
            "s.onopen = () => done('open'); s.onerror = () => done('refused') })",
            socket,
        )
        assert answer == "refused"
        page.close()
