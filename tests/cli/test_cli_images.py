"""Two crossing sweeps calibrate the tracker on a curved array, too."""

import numpy as np
from crossing_scenes import centre_error_mm, crossing_sweeps, displaced

from speckle3d.core.geometry import roll_yaw_tilt
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, Sweep, Tracker
from speckle3d.io.calibrations import read_calibration
from speckle3d.io.sweep_writer import write_sweep


def test_two_sweeps_of_a_curved_array_are_calibrated(run, tmp_path):
    grid = ImageGrid.of_fan(96, 200, 0.2, 40.0, (-0.45, 0.45))
    *sweeps, truth = crossing_sweeps(0, frames=36, grid=grid)
    files = [tmp_path / name for name in ("one.h5", "across.h5")]
    for path, made in zip(files, sweeps, strict=True):
        tracker = Tracker(made.readings)
        write_sweep(path, Sweep(made.images, grid, BModeSettings(60.0), made.frame_time_s, tracker=tracker))
    start = displaced(truth, np.random.default_rng(3), 2.0, 2.0)
    degrees = np.rad2deg(roll_yaw_tilt(start.rotation))
    code, _, err = run(
        *("calibrate", "images", *files, "-o", tmp_path / "tracker.h5", "--capture-mm", "0"),
        *("--capture-deg", "0", "--start-mm", *start.translation, "--start-deg", *degrees),
    )
    assert code == 0, err
    found = read_calibration(tmp_path / "tracker.h5")
    error, moved = centre_error_mm(found.sensor_from_image, truth, grid), found.covariance[3:, 3:]
    # As of parallel lines: 0.1 mm across and out of plane, 0.3 along the beam.
    assert np.linalg.norm(error) < 0.5
    assert np.linalg.norm(error[[0, 2]]) < 0.15
    assert np.sqrt(np.diag(moved)).max() < 1.0
