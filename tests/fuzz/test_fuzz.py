"""A bounded time of `run.py`: every kind of file, with seeds of its own in each run of the tests."""

import subprocess
import sys
from pathlib import Path

import pytest

RUN = Path(__file__).with_name("run.py")
KINDS = (
    "sweep", "curves", "calibration", "reconstruction", "scan", "tum", "toml", "xml", "points", "log",
    "metaimage", "nrrd", "volume", "surface", "picks", "stream", "igtl",
)  # fmt: skip
OTHERS = ("uff", "zea", "mat", "mat73", "dicom", "ultrasonix")
"""Formats of other systems."""


def fuzz(tmp_path, *options):
    command = [sys.executable, RUN, "--failures", tmp_path / "failures", *map(str, options)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [KINDS, OTHERS], ids=["own", "others"])
def test_no_kind_of_file_brings_a_reader_down(tmp_path, kinds):
    said = fuzz(tmp_path, "--kinds", *kinds, "--cases", 12, "--first", 10**6)
    for kind in kinds:
        assert f"{kind}: seeds 1000000 to 1000011: " in said


@pytest.mark.slow
def test_no_sweep_brings_the_whole_pipeline_down(tmp_path):
    assert "track: seeds 1000000 to 1000011: " in fuzz(
        tmp_path, "--kinds", "track", "--cases", 12, "--first", 10**6
    )


@pytest.mark.slow
def test_a_case_is_the_same_again_by_its_seed(tmp_path):
    for place in ("a", "b"):
        fuzz(tmp_path, "--case", "tum", 7, "--keep", tmp_path / place)
    assert (tmp_path / "a" / "t.txt").read_bytes() == (tmp_path / "b" / "t.txt").read_bytes()
