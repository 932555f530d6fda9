"""Clock offsets from the command line: nothing is overwritten, and what cannot be told is said in one line."""

import json

import h5py
import numpy as np
import pytest
from commands import run_command
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.calibration import Calibration, FramesUsed
from speckle3d.io.calibrations import read_calibration, write_calibration

BACK = ("--preset", "reversal", "--vectors", "20", "--samples", "1000", "--length-mm", "10", "--frames", "50")
IMAGES = ("--by", "images", "--search-s", "0.2")


@pytest.fixture(scope="module")
def back(tmp_path_factory):
    """A sweep forward and back over tissue."""
    path = tmp_path_factory.mktemp("clock") / "back.h5"
    run_command("simulate", path, *BACK, "--seed", "3")
    return path


@pytest.fixture
def held(back, tmp_path):
    """A calibration that says how the image of `back` sits, and knows no clock offset."""
    with h5py.File(back) as file:
        mounting = RigidTransform.from_matrix(file["tracker"].attrs["sensor_from_image"])
    path = tmp_path / "held.h5"
    write_calibration(path, calibration(mounting.rotation, mounting.translation))
    return path


def calibration(rotation, translation_mm):
    size = 3 if translation_mm is None else 6
    return Calibration(
        method="images",
        sensor="orientation" if translation_mm is None else "tracker",
        rotation=rotation,
        translation_mm=translation_mm,
        pixel_mm=None,
        covariance=np.eye(size),
        parameters=(),
        rms=0.1,
        rms_unit="mm",
        condition_number=1.0,
        frames=FramesUsed(1, (0,)),
    )


def test_no_input_and_nothing_but_a_calibration_is_overwritten(run, refused, back, held, tmp_path):
    other = tmp_path / "notes.txt.h5"
    other.write_text("mine")
    curves = tmp_path / "sweep.h5"
    curves.write_bytes(back.read_bytes())
    before = {path: path.read_bytes() for path in (back, held, other, curves)}
    clock = ("calibrate", "clock", back, *IMAGES, "--calibration", held)
    assert "would be overwritten" in refused(*clock, "-o", back)
    assert "would be overwritten" in refused(*clock, "-o", held)
    assert "would be overwritten" in refused(*clock, "--poses", curves, "-o", curves)
    for path in (other, curves):
        assert "is there and is not a calibration" in refused(*clock, "-o", path)
    assert {path: path.read_bytes() for path in before} == before
    again = tmp_path / "again.h5"
    write_calibration(again, read_calibration(held))
    assert run(*clock, "-o", again)[0] == 0
    assert read_calibration(again).time_offset_s == pytest.approx(-0.04, abs=0.012)
