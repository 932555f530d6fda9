"""Voxels from frames: against known scenes, and within memory."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.voxels.volume import compound

GRID = ImageGrid(vectors=9, samples=14, vector_pitch_mm=0.5, sample_spacing_mm=0.3, first_sample_depth_mm=0.7)


def world_points(grid, poses):
    """Centre of every sample in the world, shape (n, vector, sample, 3)."""
    i, j = np.mgrid[: grid.vectors, : grid.samples]
    x, y = i * grid.vector_pitch_mm, grid.first_sample_depth_mm + j * grid.sample_spacing_mm
    local = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    return np.stack([p.apply(local) for p in poses]).reshape(len(poses), *i.shape, 3)


def voxel_centres(volume):
    index = np.stack(np.indices(volume.shape), axis=-1).reshape(-1, 3)
    return volume.world_from_grid.apply(index * volume.spacing_mm).reshape(*volume.shape, 3)


def test_sphere_has_its_centre_and_volume():
    rng = np.random.default_rng(2)
    grid = ImageGrid(41, 121, 0.3, 0.1, 1.0)
    z = np.cumsum(rng.uniform(0.05, 0.35, 60))
    turned = Rotation.from_rotvec(rng.normal(0.0, 0.02, (60, 3)))
    poses = RigidTransform.from_components(np.outer(z, [0, 0, 1]), turned)
    centre, radius = np.array([6.0, 7.0, z.mean()]), 4.0
    ball = 200.0 * (np.linalg.norm(world_points(grid, poses) - centre, axis=-1) < radius)
    volume = compound(ball, grid, poses, 0.25, voxel_type="uint8")
    inside = volume.voxels > 100
    # A fifth of a voxel for the centre of mass; a fifth of a voxel all over its surface for the volume.
    np.testing.assert_allclose(voxel_centres(volume)[inside].mean(axis=0), centre, atol=0.05)
    expected_mm3, skin_mm3 = 4 / 3 * np.pi * radius**3, 4 * np.pi * radius**2 * 0.05
    assert inside.sum() * 0.25**3 == pytest.approx(expected_mm3, abs=skin_mm3)


def test_absurd_sizes_are_refused_before_a_frame_is_read():
    def read(index):
        raise AssertionError("read a frame")

    poses = RigidTransform.from_translation([[0.0, 0, 0], [0, 0, 5e4]])
    with pytest.raises(InvalidInputError, match="8 GB"):
        compound(read, GRID, poses, 0.1)
    with pytest.raises(InvalidInputError, match="voxel_type"):
        compound(read, GRID, poses[:1], 0.5, voxel_type="int8")
