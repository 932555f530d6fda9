"""A sweep while it is made, in the browser, until its sender leaves."""

import socket
import subprocess

from browsers import needs_browser, opened, running
from commands import command

pytestmark = needs_browser
RF = (
    "--sampling-rate-hz", 2e8 / 3, "--vector-pitch-mm", 0.3, "--speed-of-sound-m-s", 1540,
    "--centre-frequency-hz", 7.5e6, "--bandwidth-hz", 5e6, 10e6,
)  # fmt: skip


def read_until(process, begin):
    for line in process.stderr:
        if line.startswith(begin):
            return line.strip()
    raise AssertionError(f"no line began with {begin}")


def test_picture_length_and_end_are_shown(browser, shipped, tmp_path, monkeypatch):
    monkeypatch.setenv("BROWSER", "true")  # the one that this test brings looks at it
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    play = command("play", shipped / "phantom.h5", "--port", port)
    live = command("live", f"localhost:{port}", "-o", tmp_path / "out", "--curves", shipped / "curves.h5",
                   "--view", *RF)  # fmt: skip
    with running(play, stderr=subprocess.PIPE) as playing:
        read_until(playing, "127.0.0.1")
        with running(live, stderr=subprocess.PIPE) as session:
            page = opened(browser, read_until(session, "http"))
            page.wait_for_selector("text=/\\+1\\d\\.\\d mm ±\\d/")
            page.wait_for_selector("text=/the sweep has ended/")
            session.communicate()
            assert session.returncode == 0
    assert (tmp_path / "out" / "reconstruction.h5").is_file()
