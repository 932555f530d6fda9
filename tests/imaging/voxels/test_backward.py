"""Volumes voxel by voxel: against brute force, on any number of threads."""

import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid, Region
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.voxels.grid import grid_around
from speckle3d.imaging.voxels.volume import look_up_voxels

GRID = ImageGrid(vectors=9, samples=14, vector_pitch_mm=0.5, sample_spacing_mm=0.3, first_sample_depth_mm=0.7)


def hand_path(rng, frames, step_mm, turn_rad=0.05):
    places = rng.normal(0.0, 0.2, (frames, 3)) + np.outer(np.arange(frames) * step_mm, [0, 0, 1])
    turns = Rotation.from_rotvec(rng.normal(0.0, turn_rad, (frames, 3)))
    return RigidTransform.from_components(places, turns)


@settings(max_examples=6)
@given(
    seed=st.integers(0, 2**32 - 1),
    spacing=st.sampled_from([(0.4, 0.4, 0.4), (0.6, 0.5, 1.2), (0.9, 0.7, 0.2)]),
    reach_mm=st.sampled_from([0.3, 1.1, 5.0]),
)
def test_matches_brute_force(seed, spacing, reach_mm):
    rng = np.random.default_rng(seed)
    # Some images may face the other way; what is outside the region or NaN does not count.
    middle = RigidTransform.from_translation([2.0, 0.0, 0.0])
    half_turn = middle * RigidTransform.from_rotation(Rotation.from_rotvec([0.0, np.pi, 0.0])) * middle.inv()
    out, back = hand_path(rng, 3, 0.9), hand_path(rng, 3, 0.9) * half_turn
    poses, images = RigidTransform.concatenate([out, back]), rng.normal(size=(6, 9, 14)).astype(np.float32)
    images[2, 3:5] = np.nan
    region = Region("rectangle 0.4,0 9,4").mask(GRID)
    grid = grid_around(GRID, poses, spacing, Rotation.from_rotvec(rng.normal(0.0, 0.5, 3)))
    voxels, state = look_up_voxels(PosedImages(images, GRID, poses), grid, reach_mm, region)
    points = grid.world_from_grid.apply(np.indices(grid.shape).reshape(3, -1).T * grid.spacing_mm)
    along = grid.world_from_grid.rotation.inv().apply(poses.rotation.apply([0.0, 0.0, 1.0]))
    half = 0.5 * np.abs(along * grid.spacing_mm).max()
    visible = np.where(region, images, np.nan)
    expected = oracles.between_images(visible, GRID, poses, points, reach_mm, half)
    np.testing.assert_array_equal(state.T.ravel(), expected[1])
    # Single precision of levels of order one, of distances up to 5 mm and of their ratios.
    np.testing.assert_allclose(voxels.T.ravel(), expected[0], atol=2e-5)
