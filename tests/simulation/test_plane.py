"""Scans in a water bath: echoes where geometry says, blurred by the beam, over the motions asked for."""

import numpy as np
import pytest
from scipy.signal import hilbert
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.simulation.bath import water_bath
from speckle3d.simulation.beam import tabulate_beam
from speckle3d.simulation.presets import SimulationSettings, simulate
from speckle3d.simulation.scan import SimulatedFrames
from speckle3d.simulation.sensors import ORIENTATION_FROM_IMAGE, TRACKER_FROM_IMAGE

CENTRE_MM = (320.0, -150.0, -240.0)
"""Of a level floor, and where threads cross, in the world of the simulated tracker."""


@pytest.fixture(scope="module")
def beam():
    return tabulate_beam()


def scan(preset="plane", **changes):
    return simulate(SimulationSettings(preset=preset, **{"seed": 3, **changes}))[0]


def bath_frames(beam, reflector, poses_deg_mm, vectors=64):
    """Frames at given (tilt, roll, depth in the middle vector)."""
    image = ImageGrid(vectors, 3818, 0.3, beam.probe.signal.sample_spacing_mm)
    poses = []
    for tilt, roll, depth in poses_deg_mm:
        turn = Rotation.from_euler("YXZ", np.deg2rad([40.0, tilt, roll]))
        below = np.array([image.width_mm / 2.0, depth, 0.0])
        poses.append(RigidTransform.from_components([3.0, 0.0, -5.0] - turn.apply(below), turn))
    return SimulatedFrames(beam, water_bath(11, reflector), RigidTransform.concatenate(poses), image)


def envelopes(frame):
    return np.abs(hilbert(np.asarray(frame, float), axis=1))


@pytest.mark.slow
def test_the_bars_echo_lies_in_the_plane_that_the_truth_says():
    sweep = scan(reflector="bar", frames=8, snr_db=60.0).sweep
    lateral = np.arange(sweep.grid.vectors) * sweep.grid.vector_pitch_mm
    for frame, pose in zip(sweep.frames, sweep.truth, strict=True):
        echo = envelopes(frame)
        # The middle of the main lobe: a clipped echo has a flat top.
        near = np.argmax(echo, axis=1)[:, None] + np.arange(-12, 13)
        weight = np.take_along_axis(echo, near, axis=1) ** 2
        depth = (weight * near).sum(axis=1) / weight.sum(axis=1) * sweep.grid.sample_spacing_mm
        points = pose.apply(np.stack([lateral, depth, np.zeros(lateral.size)], axis=1))
        # A fifth of the wavelength: the converging wavefront shifts echoes by as much before the focus.
        # Slope: 0.04 mm over the image.
        assert np.median(points[:, 2]) == pytest.approx(CENTRE_MM[2], abs=0.04)
        assert abs(np.polyfit(lateral, points[:, 2], 1)[0]) * sweep.grid.width_mm < 0.04


def test_a_level_wall_reverberates_at_twice_the_depth(beam):
    wall = bath_frames(beam, "wall", [(0.0, 0.0, 14.0), (15.0, 0.0, 14.0)])
    spacing = wall.image.sample_spacing_mm
    first = envelopes(wall[0]).max(axis=1)
    level, steep = (envelopes(frame)[:, round(21.0 / spacing) : round(35.0 / spacing)] for frame in wall)
    # A quarter of the pulse's length.
    assert np.median(21.0 + np.argmax(level, axis=1) * spacing) == pytest.approx(28.0, abs=0.05)
    # Once more from floor and face is a loss, but far from noise; seen from the side none returns.
    assert 0.05 < np.median(level.max(axis=1) / first) < 0.6
    assert np.median(steep.max(axis=1)) < 0.02 * np.median(level.max(axis=1))


def test_sensors_are_left_to_calibrate_and_read_where_the_truth_is():
    sweep = scan("wires", frames=30, sensor_noise=0.0).sweep
    tracker, orientation = sweep.tracker, sweep.orientation
    assert (tracker.sensor_from_image, orientation.sensor_from_image) == (None, None)
    poses = tracker.readings.at(sweep.frame_time_s - tracker.time_offset_s) * TRACKER_FROM_IMAGE
    # Interpolation over 20 ms of tremor, with a lever of 280 mm on 0.016 deg: as in the sensors' own tests.
    assert np.abs((sweep.truth.inv() * poses).translation).max() < 0.2
    rotation = (
        orientation.readings.at(sweep.frame_time_s - orientation.time_offset_s) * ORIENTATION_FROM_IMAGE
    )
    assert np.rad2deg((sweep.truth.rotation.inv() * rotation).magnitude()).max() < 0.02


def test_crossing_threads_echo_where_the_truth_says():
    sweep = scan("wires", vectors=64, frames=6, seed=11, snr_db=60.0).sweep
    at = sweep.truth.inv().apply(CENTRE_MM)
    for frame, (lateral, depth, off) in zip(sweep.frames, at, strict=True):
        assert abs(off) < 0.3  # the hand's reach and its tremor
        echo = envelopes(frame)
        column, row = round(lateral / 0.3), round(depth / sweep.grid.sample_spacing_mm)
        near = echo[max(column - 2, 0) : column + 3, row - 40 : row + 40]
        # Only threads seen along their length come near the crossing's echo, where two of them add up.
        assert near.max() > 0.5 * echo.max()
        assert near.max() > 30.0 * np.median(echo)
