"""Voxels from frames: against brute force, against known scenes, and within memory."""

import gc
import weakref

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.sweep import ImageGrid
from speckle3d.core.volume import Volume
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.imaging.cuts.reslice import reslice_volume
from speckle3d.imaging.voxels.volume import compound, grid_around

GRID = ImageGrid(vectors=9, samples=14, vector_pitch_mm=0.5, sample_spacing_mm=0.3, first_sample_depth_mm=0.7)


def shaken(rng, frames, step_mm):
    moved = rng.normal(0.0, 0.3, (frames, 3)) + np.outer(np.arange(frames) * step_mm, [0, 0, 1])
    return RigidTransform.from_components(moved, Rotation.from_rotvec(rng.normal(0.0, 0.1, (frames, 3))))


def world_points(grid, poses):
    """Centre of every sample in the world, shape (n, vector, sample, 3)."""
    i, j = np.mgrid[: grid.vectors, : grid.samples]
    x, y = i * grid.vector_pitch_mm, grid.first_sample_depth_mm + j * grid.sample_spacing_mm
    local = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    return np.stack([p.apply(local) for p in poses]).reshape(len(poses), *i.shape, 3)


def voxel_centres(volume):
    index = np.stack(np.indices(volume.shape), axis=-1).reshape(-1, 3)
    return volume.world_from_grid.apply(index * volume.spacing_mm).reshape(*volume.shape, 3)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), voxel_mm=st.floats(0.25, 1.5), cap=st.integers(0, 4))
def test_matches_brute_force(seed, voxel_mm, cap):
    rng = np.random.default_rng(seed)
    poses, axes = shaken(rng, 5, 0.9), Rotation.random(rng=rng)
    images = rng.normal(size=(5, 9, 14)).astype(np.float32)
    images[2, 3:5] = np.nan
    volume = compound(images, GRID, poses, voxel_mm, fill_radius=cap, world_from_axes=axes)
    binned = oracles.bin_mean(
        images, world_points(GRID, poses), volume.world_from_grid, volume.spacing_mm, volume.shape
    )
    # Sums in single precision: some tens of values of order one.
    np.testing.assert_allclose(volume.voxels, oracles.fill_holes(binned, cap), atol=1e-5)


def test_bounds_hold_every_sample_and_nothing_more():
    poses = shaken(np.random.default_rng(1), 6, 0.7)
    voxels = grid_around(GRID, poses, 0.4)
    index = voxels.world_from_grid.inv().apply(world_points(GRID, poses).reshape(-1, 3)) / 0.4
    assert index.min() == pytest.approx(0.0, abs=1e-9)
    overshoot = np.array(voxels.shape) - 1 - index.max(axis=0)
    assert (overshoot >= -0.5 - 1e-6).all()
    assert (overshoot <= 0.5 + 1e-6).all()


def test_axes_are_lateral_axial_elevational_of_the_first_frame():
    poses = RigidTransform.from_translation(np.outer(np.arange(4.0), [0, 0, 1]))
    images = [np.full((9, 14), level) for level in range(4)]
    volume = compound(images, GRID, poses, 0.5, fill_radius=0)
    assert volume.shape == (9, 9, 7)
    np.testing.assert_allclose(volume.world_from_grid.translation, [0.0, 0.7, 0.0])
    np.testing.assert_array_equal(volume.voxels[4, 4], [0, np.nan, 1, np.nan, 2, np.nan, 3])


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


def test_filled_voxels_are_not_blurred():
    poses = RigidTransform.from_translation(np.outer(np.arange(5.0), [0, 0, 1]))
    images = np.random.default_rng(3).normal(size=(5, 9, 14)).astype(np.float32)
    bare = compound(images, GRID, poses, 0.5, fill_radius=0).voxels
    filled = compound(images, GRID, poses, 0.5, fill_radius=2).voxels
    known = ~np.isnan(bare)
    np.testing.assert_array_equal(filled[known], bare[known])
    assert not np.isnan(filled).any()


def test_radius_caps_the_filling():
    poses = RigidTransform.from_translation([[0.0, 0, 0], [0, 0, 10.0]])
    volume = compound(np.ones((2, 9, 14)), GRID, poses, 0.5, fill_radius=3)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(volume.voxels[4, 4])), np.arange(4, 17))


@pytest.mark.slow
def test_one_frame_in_memory_at_a_time():
    alive = []

    def read(index):
        gc.collect()
        assert sum(ref() is not None for ref in alive) == 0
        image = np.full((9, 14), index, dtype=np.float32)
        alive.append(weakref.ref(image))
        return image

    poses = RigidTransform.from_translation(np.outer(np.arange(8.0), [0, 0, 1]))
    compound(read, GRID, poses, 1.0)
    assert len(alive) == 8 + 1  # the first is looked at for its type, too


def test_uint8_rounds_clips_and_marks_empty_as_zero():
    poses = RigidTransform.from_translation([[0.0, 0, 0], [0, 0, 2.0], [0, 0, 4.0]])
    images = [np.full((9, 14), level) for level in (12.6, -5.0, 300.0)]
    volume = compound(images, GRID, poses, 1.0, fill_radius=0, voxel_type="uint8")
    np.testing.assert_array_equal(volume.voxels[2, 2], [13, 0, 0, 0, 255])


def test_absurd_sizes_are_refused_before_a_frame_is_read():
    def read(index):
        raise AssertionError("read a frame")

    poses = RigidTransform.from_translation([[0.0, 0, 0], [0, 0, 5e4]])
    with pytest.raises(InvalidInputError, match=r"4 GB .* 41 x 40 x 500001"):
        compound(read, GRID, poses, 0.1)
    with pytest.raises(InvalidInputError, match="voxel_mm"):
        compound(read, GRID, poses, 0.0)
    with pytest.raises(InvalidInputError, match="voxel_type"):
        compound(read, GRID, poses[:1], 0.5, voxel_type="int8")
    with pytest.raises(InvalidInputError, match="fill_radius"):
        compound(read, GRID, poses[:1], 0.5, fill_radius=-1)


def test_no_values_is_an_error():
    with pytest.raises(InsufficientDataError):
        compound(np.full((1, 9, 14), np.nan), GRID, RigidTransform.identity(1), 0.5)


def test_reslice_of_a_volume_is_exact_on_a_linear_field():
    rng = np.random.default_rng(4)
    pose = RigidTransform.from_components([5.0, -3.0, 2.0], Rotation.random(rng=rng))
    volume = Volume(np.zeros((12, 10, 9), dtype=np.float32), (0.5, 0.6, 0.7), pose)
    gradient = np.array([1.0, -2.0, 0.5])
    volume = Volume((voxel_centres(volume) @ gradient).astype(np.float32), volume.spacing_mm, pose)
    middle = pose * RigidTransform.from_translation([1.0, 2.0, 2.5])
    plane = ReslicePlane(middle, 6.0, 3.0, 0.5)
    cut = reslice_volume(volume, plane)
    rows, columns = np.indices(plane.shape)
    local = np.stack([columns, rows, 0 * rows], axis=-1) * 0.5
    expected = plane.world_from_plane.apply(local.reshape(-1, 3)).reshape(*plane.shape, 3) @ gradient
    expected[columns * 0.5 + 1.0 > 11 * 0.5] = np.nan
    # Single precision of voxel values of order ten.
    np.testing.assert_allclose(cut, expected, atol=1e-5)
