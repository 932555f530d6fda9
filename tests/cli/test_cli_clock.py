"""Clock offsets from the command line: nothing is overwritten, what cannot be told is one line."""

import h5py
import pytest
from calibration_files import example_calibration
from scipy.spatial.transform import RigidTransform

from speckle3d.io.family.calibrations import read_calibration, write_calibration

IMAGES = ("--by", "images", "--search-s", "0.2")


@pytest.fixture
def mounting_file(back, tmp_path):
    """A calibration that says how the image of `back` sits, and knows no clock offset."""
    with h5py.File(back) as file:
        mounting = RigidTransform.from_matrix(file["tracker"].attrs["sensor_from_image"])
    path = tmp_path / "held.h5"
    pose = {"rotation": mounting.rotation, "translation_mm": mounting.translation}
    write_calibration(path, example_calibration(time_offset_s=None, pixel_mm=None, **pose))
    return path


def test_a_clock_is_found_from_images_and_its_calibration_goes_over_no_input(
    run, refuse, back, mounting_file, tmp_path
):
    before = mounting_file.read_bytes()
    clock = ("calibrate", "clock", back, *IMAGES, "--calibration", mounting_file)
    assert str(mounting_file) in refuse(*clock, "-o", mounting_file)
    assert mounting_file.read_bytes() == before
    code, out, err = run(*clock, "-o", tmp_path / "c.h5")
    assert code == 0, err
    assert "s (95 %)" in out
    assert read_calibration(tmp_path / "c.h5").time_offset_s == pytest.approx(-0.04, abs=0.012)
