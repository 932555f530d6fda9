"""A sweep while it is made, in the browser, until its sender leaves."""

import subprocess

from browsers import needs_browser, open_page, running
from commands import RF, command, free_port, read_until

pytestmark = needs_browser


def test_the_page_has_picture_length_and_end(browser, data_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("BROWSER", "true")  # the one that this test brings looks at it
    port = free_port()
    # More slowly than it came: a page on a busy machine lags.
    play = command("play", data_folder / "phantom.h5", "--port", port, "--rate", "0.3")
    live = command("live", f"localhost:{port}", "-o", tmp_path / "out", "--curves", data_folder / "curves.h5",
                   "--view", *RF)  # fmt: skip
    with running(live, stderr=subprocess.PIPE) as session:
        page = open_page(browser, read_until(session, "http"))
        page.wait_for_selector("text=/waiting for/")
        with running(play, stderr=subprocess.PIPE):
            page.wait_for_selector("text=/\\+\\d+\\.\\d mm ±\\d/")
            page.wait_for_selector("text=/the sweep has ended/")
            session.communicate()
            assert session.returncode == 0
    assert (tmp_path / "out" / "reconstruction.h5").is_file()
