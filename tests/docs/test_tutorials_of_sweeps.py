"""Tutorials of a sweep and of a study run as written, in order, each in an empty folder."""

import pytest
from pages import run_tutorial

pytestmark = pytest.mark.slow


def test_a_sweep_becomes_cuts_measures_a_volume_and_a_scene(tmp_path):
    folder, printed = run_tutorial("reconstruct.md", tmp_path)
    assert "length_mm" in printed
    for name in ("volume.nrrd", "along.png", "scene/scene.mrml", "out/enlarged.png"):
        assert (folder / name).exists()


def test_a_study_of_three_sweeps_is_reported(tmp_path):
    folder, printed = run_tutorial("compare.md", tmp_path)
    assert (folder / "study" / "report.html").exists()
    assert "no two modes are told apart" in printed
