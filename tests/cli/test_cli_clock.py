"""Clock offsets from the command line: nothing is overwritten, what cannot be told is one line."""

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.calibration import Calibration, FramesUsed
from speckle3d.io.calibrations import read_calibration, write_calibration

IMAGES = ("--by", "images", "--search-s", "0.2")


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


@pytest.fixture
def noise(back, tmp_path):
    """The readings of `back` with images of nothing."""
    path = tmp_path / "noise.h5"
    path.write_bytes(back.read_bytes())
    with h5py.File(path, "r+") as file:
        file["rf"][...] = np.random.default_rng(0).normal(0, 300, file["rf"].shape).astype(np.int16)
    return path


def test_images_that_show_nothing_leave_no_calibration(refused, noise, held, tmp_path):
    line = refused("calibrate", "clock", noise, *IMAGES, "--calibration", held, "-o", tmp_path / "c.h5")
    assert "--search-s" in line
    assert str(noise) in line


def test_a_calibration_of_another_sensor_is_refused(refused, back, tmp_path):
    held = tmp_path / "imu.h5"
    write_calibration(held, calibration(Rotation.identity(), None))
    assert "expected --calibration" in refused("calibrate", "clock", back, *IMAGES, "-o", tmp_path / "c.h5")
    line = refused("calibrate", "clock", back, "--calibration", held, "-o", tmp_path / "c.h5")
    assert str(held) in line
    assert "orientation" in line


def test_frames_in_which_no_line_is_seen_are_counted(refused, noise):
    line = refused("calibrate", "clock", noise)
    assert "20 frames" in line
    assert " of 50: " in line
    assert "--by images" in line


def test_tissue_is_not_taken_for_a_plane(refused, back):
    # In 43 frames something like a line is seen; it once followed the sensor by 98 %, 95 ms off.
    assert " 8 numbers" in refused("calibrate", "clock", back)
