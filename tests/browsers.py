"""Debian's Chromium without a window, for tests of pages; they skip where it or Playwright is not at hand."""

import importlib.util
import shutil
import subprocess
import sys
import threading
from contextlib import contextmanager

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    # A popup of the browser's own, unseen, that takes a whole core.
    "--disable-features=WebUIOmniboxAimPopup,WebUIOmniboxPopup",
]  # fmt: skip
SOFTWARE_WEBGL = ["--enable-unsafe-swiftshader", "--use-angle=swiftshader"]

needs_browser = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("playwright") is None, reason="needs playwright (extra browser-test)"
    ),
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium on the path (Debian's package chromium)"),
]


LIMIT_S = 900
"""For so long a server of a test may run, whatever becomes of the test."""


@contextmanager
def chromium():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*ARGUMENTS, *SOFTWARE_WEBGL])
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def running(command, **streams):
    """A process that does not outlive the block nor the limit; `Popen` by itself waits without one."""
    with subprocess.Popen(list(map(str, command)), text=True, **streams) as process:
        limit = threading.Timer(LIMIT_S, process.kill)
        limit.start()
        try:
            yield process
        finally:
            limit.cancel()
            process.kill()


@contextmanager
def viewing(*arguments):
    """The address that `speckle3d view ...` serves; the server has its port and everything to itself."""
    command = [sys.executable, "-m", "speckle3d.cli", "view", "--no-browser", *arguments]
    with running(command, stderr=subprocess.PIPE) as server:
        output = []
        for line in server.stderr:
            output.append(line)
            if line.startswith("http"):
                break
        else:
            raise AssertionError("".join(output))
        drain = threading.Thread(target=lambda: output.extend(server.stderr), daemon=True)
        drain.start()
        yield output[-1].strip()
        server.terminate()
        server.wait(LIMIT_S)
        drain.join(5)
        assert not [line for line in output if "Traceback" in line], "".join(output)


def open_page(browser, address):
    """A page with what it complained of and asked for in `complaints` and `requests`."""
    page = browser.new_page(viewport={"width": 1366, "height": 768})
    # Where no kernel has been compiled yet, that comes first.
    page.set_default_timeout(300_000)
    page.complaints, page.requests = [], []
    page.on(
        "console", lambda m: page.complaints.append(f"{m.text} {m.location}") if m.type == "error" else None
    )
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.on(
        "request", lambda r: page.requests.append(r.url) if not r.url.startswith(("data:", "blob:")) else None
    )
    page.goto(address)
    return page
