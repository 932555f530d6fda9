"""Deviation of position per voxel: along the sweep, smooth, empty where there is nothing."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.core.poses import PoseErrors
from speckle3d.imaging.measures.belonging import belonging_of
from speckle3d.imaging.measures.uncertainty import deviation_volume, deviations
from speckle3d.imaging.voxels.grid import VoxelGrid, grid_around

GRID = ImageGrid(31, 41, 0.5, 0.5)


def sweep_of_open_scale(frames=41, turn_deg=0.0, sigma=0.05):
    """A sweep of 20 mm whose scale is uncertain."""
    t = np.linspace(0, 1, frames)
    turns = Rotation.from_rotvec(np.deg2rad(turn_deg) * np.column_stack([0 * t, t, 0.5 * t]))
    poses = RigidTransform.from_components(np.column_stack([0 * t, 0 * t, 20 * t]), turns)
    factors = np.zeros((2, frames, 6))
    factors[0, :, 2] = sigma * 20 * t
    factors[1, :, 4] = 0.01 * t
    return PoseErrors(factors, poses, GRID.centre_mm)


def test_interpolated_deviations_are_those_of_the_voxels_themselves():
    """A turning sweep: at voxels in it against the exact value there, to a hundredth of the largest."""
    errors = sweep_of_open_scale(turn_deg=8.0)
    grid = grid_around(GRID, errors.world_from_image, 0.7, Rotation.from_euler("y", 0.3))
    index = np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3)[::29]
    world = grid.world_from_grid.apply(index * np.array(grid.spacing_mm))
    between = belonging_of(world, GRID, errors.world_from_image).gap_mm < 1e-9
    index, world = index[between], world[between]
    deviation = deviation_volume(errors, GRID, grid)[tuple(index[:, ::-1].T)]
    exact = deviations(errors, GRID, world)
    assert len(index) > 500
    assert np.abs(deviation - exact).max() < 0.01 * exact.max()


def test_empty_voxels_have_no_value_and_one_voxel_has_its_own():
    errors = sweep_of_open_scale()
    grid = grid_around(GRID, errors.world_from_image, 0.9)
    state = np.random.default_rng(0).integers(0, 3, grid.shape[::-1]).astype(np.uint8)
    np.testing.assert_array_equal(np.isnan(deviation_volume(errors, GRID, grid, state)), state == 0)
    centre = RigidTransform.from_translation(errors.world_from_image[20].apply(GRID.centre_mm))
    single = deviation_volume(errors, GRID, VoxelGrid((1, 1, 1), (0.5, 0.5, 0.5), centre))
    # Half of the sweep at 5 % of 20 mm.
    assert single[0, 0, 0] == pytest.approx(0.5, rel=1e-3)
