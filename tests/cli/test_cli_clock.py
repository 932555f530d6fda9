"""Clock offsets from the command line: nothing is overwritten, what cannot be told is one line."""

import json

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


def test_no_input_and_nothing_but_a_calibration_is_overwritten(run, refused, back, held, tmp_path):
    other = tmp_path / "notes.txt.h5"
    other.write_text("mine")
    curves = tmp_path / "sweep.h5"
    curves.write_bytes(back.read_bytes())
    before = {path: path.read_bytes() for path in (back, held, other, curves)}
    clock = ("calibrate", "clock", back, *IMAGES, "--calibration", held)
    assert str(back) in refused(*clock, "-o", back)
    assert str(held) in refused(*clock, "-o", held)
    assert str(curves) in refused(*clock, "--poses", curves, "-o", curves)
    for path in (other, curves):
        assert str(path) in refused(*clock, "-o", path)
    assert {path: path.read_bytes() for path in before} == before
    again = tmp_path / "again.h5"
    write_calibration(again, read_calibration(held))
    assert run(*clock, "-o", again)[0] == 0
    assert read_calibration(again).time_offset_s == pytest.approx(-0.04, abs=0.012)


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


def test_what_is_printed_for_machines_is_json_even_if_numbers_are_not(run, back, monkeypatch):
    from calibration.clock import images as clock_images
    from calibration.clock.offset import ClockOffset

    odd = ClockOffset(0.0, float("inf"), 1.0)
    monkeypatch.setattr(clock_images, "delay_from_images", lambda *_args, **_named: odd)
    code, text, err = run("calibrate", "clock", back, *IMAGES, "--json")
    assert code == 0, err
    told = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert told["standard_error_s"] is None
