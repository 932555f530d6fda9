"""Tutorials of calibrations and curves run as written, in order, each in an empty folder."""

import pytest
from pages import ROOT, run_page

TUTORIALS = ROOT / "docs" / "tutorials"


def ran(name, tmp_path):
    folder = tmp_path / "empty"
    folder.mkdir()
    return folder, run_page(TUTORIALS / name, folder)


@pytest.mark.slow
def test_a_plane_calibrates_both_sensors_for_a_sweep_that_knew_neither(tmp_path):
    folder, printed = ran("plane.md", tmp_path)
    rows = [line.split() for line in printed.splitlines() if line.startswith("sweep  f")]
    errors = {row[2]: abs(float(row[7])) for row in rows}
    # Of 5.5 mm the tracker's jitter alone is 2 %, and its calibration's error another.
    assert errors["pose"] < 8.0
    assert (folder / "calibrated.h5").exists()
    assert not (folder / "stiff-tracker.h5").exists()


@pytest.mark.slow
def test_curves_of_a_phantom_and_of_a_data_sheet(tmp_path):
    folder, printed = ran("curves.md", tmp_path)
    assert "fall" in printed
    assert (folder / "sheet.h5").exists()
