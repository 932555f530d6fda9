"""Crossing wires from images to a calibration with the public command, nothing picked by hand."""

import json

import numpy as np
import pytest
from crossing_images import crossing_world

from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import BModeSettings, ImageGrid, Sweep, Tracker
from speckle3d.io.calibrations import read_calibration
from speckle3d.io.points import read_points
from speckle3d.io.sweep_writer import write_sweep


def written(path, world, order=None):
    """The frames of a world and its tracker's readings, in the order of other frames if given."""
    frames, columns, rows = world.images.shape
    times = np.arange(frames) / 5.0
    poses = world.world_from_sensor if order is None else world.world_from_sensor[order]
    # What a user reads off the scanner's ruler, to two digits.
    grid = ImageGrid(columns, rows, *(float(f"{size:.2g}") for size in world.pixel_mm))
    tracker = Tracker(TimedPoses(times, poses, max_gap_s=1.0))
    write_sweep(path, Sweep(world.images, grid, BModeSettings(60.0), times, tracker=tracker))
    return path


@pytest.mark.slow
def test_crossing_wires_are_found_and_calibrated_with(run, refused, tmp_path):
    world = crossing_world(7, 36)
    images, out = written(tmp_path / "wires.h5", world), tmp_path / "cal.h5"
    command = ("calibrate", "wires", images, "-o", out, "--phantom", "cross")
    code, text, err = run(*command, "--validation", images, "--json")
    assert code == 0, err
    told, found = json.loads(text), read_calibration(out)
    assert told["method"] == "cross-wire"
    assert found.rms < 1.0
    picked = read_points(out.with_suffix(".csv"), ())
    away = np.hypot(*((picked.pixels - world.crossing_px[picked.frame]) * world.pixel_mm).T)
    assert len(picked) == len(np.unique(picked.frame))
    assert np.isin(np.flatnonzero(world.shown), picked.frame[away < 2.0]).mean() >= 0.8
    dropped = found.frames.dropped
    assert set(dropped) | set(found.frames.used) == set(range(36))
    assert any("nothing within 4 mm" in why for why in dropped.values())
    np.testing.assert_allclose(found.pixel_mm, world.pixel_mm, rtol=0.06)
    # The middle of what the crossing covered; tracker and beam leave half a millimetre, often.
    middle = np.median(world.crossing_px, axis=0)
    places = [
        pose.apply([*(middle * size), 0.0])
        for pose, size in (
            (found.sensor_from_image, found.pixel_mm),
            (world.sensor_from_image, world.pixel_mm),
        )
    ]
    assert np.linalg.norm(places[0] - places[1]) < 2.0
    assert any("not used: RMS residual" in line for line in told["notes"])
    exchanged = written(tmp_path / "exchanged.h5", world, np.random.default_rng(0).permutation(36))
    line = refused("calibrate", "wires", exchanged, "-o", tmp_path / "no.h5", "--phantom", "cross")
    assert "chance gives" in line
    assert "of 36 frames" in line
