"""A sensor on a port, in the browser: shown, judged, recorded, unplugged."""

import tempfile
from pathlib import Path

import pytest
from browsers import needs_browser, open_page, viewing

from xsens.logs.read import read_log

pytestmark = needs_browser


@pytest.fixture
def sensor(tmp_path):
    from simulated_device import SimulatedDevice  # not everywhere are there pseudo-terminals

    with SimulatedDevice(tmp_path / "port", kind="mtdata2", rate_hz=100.0) as device:
        yield device


def scratch_folders():
    return set(Path(tempfile.gettempdir()).glob("speckle3d-*"))


def test_it_is_shown_judged_and_recorded_until_the_end(browser, sensor, tmp_path):
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
