"""Tutorials of curves and of handhelds run as written, in order, each in an empty folder."""

import pytest
from pages import run_tutorial

pytestmark = pytest.mark.slow


def test_curves_of_a_phantom_and_of_a_data_sheet(tmp_path):
    folder, printed = run_tutorial("curves.md", tmp_path)
    assert "correlation falls to one half" in printed
    assert (folder / "sheet.h5").exists()


def test_a_handhelds_sweep_becomes_a_volume(tmp_path):
    folder, _ = run_tutorial("handheld.md", tmp_path)
    assert (folder / "volume.nrrd").exists()
