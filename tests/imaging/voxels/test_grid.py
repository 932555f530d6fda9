"""Grids: as asked for to the last bit, around all images, and small."""

import numpy as np
from drifting import hand_sweep
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.axes import principal_axes, sweep_axes
from speckle3d.imaging.voxels.grid import grid_around, spacing_within

GRID = ImageGrid(
    vectors=41, samples=60, vector_pitch_mm=0.5, sample_spacing_mm=0.4, first_sample_depth_mm=2.0
)


@settings(max_examples=8)
@given(
    seed=st.integers(0, 2**32 - 1),
    turns=st.integers(0, 2),
    spacing=st.tuples(*[st.floats(0.2, 3.0)] * 3),
    way=st.integers(0, 2),
)
def test_every_image_corner_is_within_the_grid(seed, turns, spacing, way):
    poses = hand_sweep(np.random.default_rng(seed), 20, 40.0, turns)
    axes = (None, sweep_axes(poses), principal_axes(GRID, poses))[way]
    voxels = grid_around(GRID, poses, spacing, axes)
    corners = np.concatenate([poses.apply(corner) for corner in GRID.corners_mm])
    index = voxels.world_from_grid.inv().apply(corners) / voxels.spacing_mm
    # In the voxels, which reach half a voxel beyond their centres, and in no others.
    assert (index > -0.5).all()
    assert (index < np.array(voxels.shape) - 0.5 + 1e-5).all()
    assert (index.max(axis=0) > np.array(voxels.shape) - 1.5 - 1e-5).all()
    assert voxels.spacing_mm == spacing


def test_what_is_asked_for_is_had_to_the_last_bit():
    rng = np.random.default_rng(0)
    poses = hand_sweep(rng, 6, 40.0)
    spacing, origin, shape = (0.37, 1.1, 0.051), (-7.3, 123.456, 0.1), (30, 7, 1)
    for axes in (None, Rotation.random(rng=rng)):
        voxels = grid_around(GRID, poses, spacing, axes, origin_mm=origin, shape=shape)
        assert (voxels.shape, voxels.spacing_mm) == (shape, spacing)
        turn, place = voxels.world_from_grid.rotation, voxels.world_from_grid.translation
        np.testing.assert_array_equal(place, origin)
        # SciPy normalises a turn each time it is passed on.
        assert (turn.inv() * (axes or Rotation.identity())).magnitude() < 1e-14
        # A size of so many voxels is so many voxels.
        size = tuple(np.multiply(shape, spacing))
        assert grid_around(GRID, poses, spacing, axes, origin_mm=origin, size_mm=size).shape == shape


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1), gigabytes=st.floats(1e-7, 10.0))
def test_the_spacing_within_a_memory_is_the_finest_round_one(seed, gigabytes):
    poses = hand_sweep(np.random.default_rng(seed), 8, 40.0)
    axes = sweep_axes(poses)
    spacing_mm = spacing_within(GRID, poses, gigabytes, axes)

    def memory(spacing):
        return grid_around(GRID, poses, spacing, axes).size_gb("uint8")

    steps = ("1.0", "1.2", "1.5", "2.0", "2.5", "3.0", "4.0", "5.0", "6.0", "8.0")
    assert f"{spacing_mm:.1e}".split("e")[0] in steps
    assert memory(spacing_mm) <= gigabytes
    if spacing_mm > 0.4:  # the samples' spacing, than which none is finer
        rounds = [float(f"{step}e{power}") for power in range(-2, 3) for step in steps]
        assert memory(max(spacing for spacing in rounds if spacing < spacing_mm)) > gigabytes
