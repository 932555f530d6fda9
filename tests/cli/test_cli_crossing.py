"""Calibration from two crossing sweeps on the command line, from 8-bit sequences to the report."""

import json

import crossing_scenes
import numpy as np
import pytest
from image_examples import write_mha

from speckle3d.core.geometry import roll_yaw_tilt
from speckle3d.core.grid import ImageGrid
from speckle3d.io.calibrations import read_calibration

GRID = ImageGrid(64, 90, 0.45, 0.4)


def write_sequence(path, tracked):
    """The sweep as 8-bit B-mode with a tracker's poses, in PLUS's form."""
    frames = []
    for number, pose in enumerate(tracked.readings.world_from_sensor.as_matrix()):
        frames.append(
            {
                "ProbeToTrackerTransform": " ".join(f"{value:.6f}" for value in pose.ravel()),
                "ProbeToTrackerTransformStatus": "OK",
                "Timestamp": f"{tracked.frame_time_s[number]:.4f}",
                "ImageStatus": "OK",
            }
        )
    write_mha(path, tracked.images.transpose(0, 2, 1), [("UltrasoundImageOrientation", "MF")], frames)


@pytest.fixture(scope="module")
def sequences(tmp_path_factory):
    folder = tmp_path_factory.mktemp("crossing")
    first, second, truth = crossing_scenes.crossing_sweeps(5, frames=40, grid=GRID)
    paths = folder / "a.igs.mha", folder / "b.igs.mha"
    for path, tracked in zip(paths, (first, second), strict=True):
        write_sequence(path, tracked)
    return *paths, truth


def start_of(mounting):
    angles = np.rad2deg(roll_yaw_tilt(mounting.rotation))
    return ["--start-mm", *mounting.translation, "--start-deg", *angles]


PIXELS = ("--pixel-mm", GRID.vector_pitch_mm, GRID.sample_spacing_mm)


@pytest.mark.slow
def test_two_sequences_give_a_calibration_with_its_report(run, sequences, tmp_path):
    first, second, truth = sequences
    start = crossing_scenes.displaced(truth, np.random.default_rng(3), 2.0, 2.0)
    out = tmp_path / "cal.h5"
    options = (*PIXELS, *start_of(start), "--capture-mm", "0", "--capture-deg", "0", "--json")
    code, text, err = run("calibrate", "images", first, second, "-o", out, *options)
    assert code == 0, err
    found = read_calibration(out)
    error = crossing_scenes.centre_error_mm(found.sensor_from_image, truth, GRID)
    assert np.linalg.norm(error) < 0.5
    told = json.loads(text)
    assert told["method"] == "images"
    assert told["verdict"] == "sufficient"
    assert told["notes"]
    assert found.frames.given == 80
    assert (tmp_path / "cal.txt").is_file()
    assert (tmp_path / "cal.png").stat().st_size > 50_000
