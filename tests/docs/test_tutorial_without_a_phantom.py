"""The tutorial of two crossing sweeps runs as written, in order, in an empty folder."""

import pytest
from pages import run_tutorial


@pytest.mark.slow
def test_two_sweeps_calibrate_the_tracker_and_one_taken_for_both_does_not(tmp_path):
    folder, printed = run_tutorial("without-phantom.md", tmp_path)
    assert "sufficient" in printed
    assert (folder / "tracker.h5").exists()
    assert not (folder / "none.h5").exists()
