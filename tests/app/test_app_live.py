"""A sweep and a sensor in the browser while they are recorded; in turn, as each page keeps a core busy."""

import subprocess
import tempfile
from pathlib import Path

import pytest
from browsers import needs_browser, open_page, running, viewing
from commands import RF, command, free_port, read_until

from xsens.logs.read import read_log

pytestmark = needs_browser


@pytest.fixture
def sensor(tmp_path):
    from simulated_device import SimulatedDevice  # not everywhere are there pseudo-terminals

    with SimulatedDevice(tmp_path / "port", kind="mtdata2", rate_hz=100.0) as device:
        yield device


def scratch_folders():
    return set(Path(tempfile.gettempdir()).glob("speckle3d-*"))


def test_a_sensor_is_shown_judged_and_recorded_until_the_end(browser, sensor, tmp_path):
    out, before = tmp_path / "out.mtb", scratch_folders()
    with viewing(sensor.path, "--record", out) as address:
        page = open_page(browser, address)
        page.wait_for_selector("text=The magnetometer can be trusted here")
        assert page.is_visible("text=0 samples, 0 interruptions")
        assert page.is_visible(f"text=in {out}")
        sensor.unplug()
        page.wait_for_selector("text=The sensor is not connected")
        sensor.plug()
        page.wait_for_selector("text=1 interruptions")
        page.wait_for_selector("text=The magnetometer can be trusted here")
        assert page.complaints == []
        page.close()
    log = read_log(out)
    assert len(log) > 300
    assert log.lost == 0
    assert log.oriented.all()
    assert scratch_folders() == before


def test_a_sweeps_page_has_picture_length_and_end(browser, data_folder, tmp_path, monkeypatch):
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
