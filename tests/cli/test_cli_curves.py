"""Curves from a data sheet on the command line, and what is wrong with it told in one line."""

import pytest

from speckle3d.io.curves import read_curves

LENS = "elevation_aperture_mm = 5.0\nelevation_focus_mm = 20.0\n"
SHEET = LENS + "band_mhz = [5.0, 10.0]\n"
ALONE = SHEET + "sampling_rate_mhz = 40.0\nvector_pitch_mm = 0.3\ndepth_mm = 9.0\n"


@pytest.fixture
def sheet(tmp_path):
    def write(text):
        (tmp_path / "probe.toml").write_text(text)
        return tmp_path / "probe.toml"

    return write


def test_a_data_sheet_makes_curves(run, sheet, tmp_path):
    code, shown, _ = run("calibrate", "curves", "--probe", sheet(ALONE), "-o", tmp_path / "c.h5")
    assert code == 0
    found = read_curves(tmp_path / "c.h5")
    assert (found.origin, found.key.vector_pitch_mm, found.nominal.focus_mm) == ("data sheet", 0.3, 20.0)
    assert shown.startswith("calculated, not measured; correlation falls to one half at")
    assert f"+- {196 * found.scale_sigma:.1f} % (95 %)" in shown
