"""Calibration files on the command line: put on the sensors of a sweep."""

import numpy as np
import pytest
from calibration_files import example_calibration
from scipy.spatial.transform import Rotation

from speckle3d.io.family.calibrations import write_calibration
from speckle3d.io.family.reconstructions import read_reconstruction
from speckle3d.io.load import load_sweep
from speckle3d.study.images import GreyImages


@pytest.fixture(scope="session")
def sweep(bench):
    return load_sweep(bench / "sweep.h5")


def test_a_turned_calibration_turns_the_reference(run, bench, sweep, tmp_path):
    """The image turned by 30 degrees about its own normal: the world's poses turn with it."""
    about_z = Rotation.from_euler("z", 30, degrees=True)
    mounting, path, grid = sweep.tracker.sensor_from_image, tmp_path / "cal.h5", GreyImages(sweep, 60.0).grid
    pose = {
        "rotation": mounting.rotation * about_z,
        "translation_mm": mounting.translation,
        "time_offset_s": None,
    }
    pixel_mm = np.array([grid.vector_pitch_mm, grid.sample_spacing_mm])
    write_calibration(path, example_calibration("tracker", pixel_mm=pixel_mm, **pose))
    options = ("--drift", "pose", "--calibration", path)
    code, _, err = run("reconstruct", bench / "sweep.h5", "-o", tmp_path / "o", *options)
    assert code == 0, err
    assert "30 degrees and 0 mm" in err
    plain = sweep.tracker.world_from_image(sweep.frame_time_s[:1]).rotation
    first = read_reconstruction(tmp_path / "o" / "reconstruction.h5").poses["pose"][0].rotation
    # The correction smooths the tracker's jitter of some tenths of a degree.
    assert np.rad2deg(((plain * about_z).inv() * first).magnitude()) < 2.0
