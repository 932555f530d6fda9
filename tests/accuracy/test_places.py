"""Sensors, voxels, wires and calibrations put things where and when they are."""

import numpy as np
import pytest
from calibration_examples import PIXEL_MM, scan_plane
from scipy.spatial.transform import RigidTransform
from wire_scenes import PIXEL_MM as DOT_MM
from wire_scenes import candidates, scene

from calibration.nwires import label_by_wires
from calibration.plane import calibrate_plane
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.voxels.volume import compound
from speckle3d.io.load import load_sweep


@pytest.fixture(scope="module")
def phantom(shipped):
    return load_sweep(shipped / "phantom.h5")


def test_tracker_and_images_have_one_clock(phantom):
    poses = phantom.tracker.world_from_image(phantom.frame_time_s)
    # At 3 mm/s a clock that is off by 50 ms leaves 0.15 mm; the jitter of 0.15 mm on 190 readings, 0.011.
    off_mm = (phantom.truth.inv() * poses).apply(phantom.grid.centre_mm) - phantom.grid.centre_mm
    assert np.abs(off_mm.mean(axis=0)).max() < 0.05


def test_orientation_sensor_turns_with_the_images(phantom):
    turns = phantom.orientation.world_from_image(phantom.frame_time_s) * phantom.truth.rotation.inv()
    # Its heading wanders by 0.5 degrees.
    assert np.degrees(turns.magnitude()).max() < 2.0


def test_a_bright_pixel_is_in_the_voxel_at_its_place():
    grid = ImageGrid(vectors=9, samples=14, vector_pitch_mm=0.5, sample_spacing_mm=0.5)
    images = np.zeros((11, 9, 14), np.float32)
    images[4, 5, 6] = 1.0
    poses = RigidTransform.from_translation([[1.0, 2.0, 3.0 + 0.5 * frame] for frame in range(11)])
    volume = compound(images, grid, poses, 0.5)
    brightest = np.unravel_index(np.nanargmax(volume.voxels), volume.shape)
    place_mm = volume.world_from_grid.apply(np.array(brightest) * volume.spacing_mm)
    np.testing.assert_allclose(place_mm, [3.5, 5.0, 5.0], atol=1e-6)


def test_dots_get_the_labels_of_their_wires():
    shown = scene(9, frames=10)
    dots = candidates(shown, 1)
    labelled = label_by_wires(dots, shown.phantom, shown.world_from_sensor, DOT_MM)
    off_mm = (labelled.pixels - shown.pixels[labelled.frame, labelled.wire]) * DOT_MM
    # Dots are placed to 0.1 mm, wires are 5 mm apart or more.
    assert np.mean(np.abs(off_mm).max(axis=1) < 0.5) > 0.95


def test_a_plane_calibration_has_the_scale_of_the_pixels():
    scan = scan_plane(np.random.default_rng(3), 200)
    solution = calibrate_plane(scan.lines)
    np.testing.assert_allclose(solution.chain.pixel_mm, PIXEL_MM, rtol=1e-3)
