"""Clock offsets from the command line: nothing is overwritten, what cannot be told is one line."""

import h5py
import pytest
from calibration_files import example_calibration
from scipy.spatial.transform import RigidTransform

from speckle3d.io.calibrations import read_calibration, write_calibration

IMAGES = ("--by", "images", "--search-s", "0.2")


@pytest.fixture
def held(back, tmp_path):
    """A calibration that says how the image of `back` sits, and knows no clock offset."""
    with h5py.File(back) as file:
        mounting = RigidTransform.from_matrix(file["tracker"].attrs["sensor_from_image"])
    path = tmp_path / "held.h5"
    placed = {"rotation": mounting.rotation, "translation_mm": mounting.translation}
    write_calibration(path, example_calibration(time_offset_s=None, pixel_mm=None, **placed))
    return path


def test_a_clock_is_found_from_images_and_its_calibration_goes_over_no_input(
    run, refused, back, held, tmp_path
):
    before = held.read_bytes()
    clock = ("calibrate", "clock", back, *IMAGES, "--calibration", held)
    assert str(held) in refused(*clock, "-o", held)
    assert held.read_bytes() == before
    code, out, err = run(*clock, "-o", tmp_path / "c.h5")
    assert code == 0, err
    assert "s (95 %)" in out
    assert read_calibration(tmp_path / "c.h5").time_offset_s == pytest.approx(-0.04, abs=0.012)
