"""Sensors say where and when the images were taken."""

import numpy as np
import pytest

from speckle3d.io.load import load_sweep


@pytest.fixture(scope="module")
def phantom(data_folder):
    return load_sweep(data_folder / "phantom.h5")


def test_tracker_and_images_have_one_clock(phantom):
    poses = phantom.tracker.world_from_image(phantom.frame_time_s)
    # At 3 mm/s a clock that is off by 50 ms leaves 0.15 mm; the jitter of 0.15 mm on 190 readings, 0.011.
    off_mm = (phantom.truth.inv() * poses).apply(phantom.grid.centre_mm) - phantom.grid.centre_mm
    assert np.abs(off_mm.mean(axis=0)).max() < 0.05


def test_orientation_sensor_turns_with_the_images(phantom):
    turns = phantom.orientation.world_from_image(phantom.frame_time_s) * phantom.truth.rotation.inv()
    # Its heading wanders by 0.5 degrees.
    assert np.degrees(turns.magnitude()).max() < 2.0
