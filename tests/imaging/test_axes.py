"""Axes of voxels: the images' mean, and those of the smallest box."""

import numpy as np
from drifting import hand_sweep
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.axes import principal_axes, sweep_axes
from speckle3d.imaging.voxels.grid import grid_around

GRID = ImageGrid(
    vectors=41, samples=60, vector_pitch_mm=0.5, sample_spacing_mm=0.4, first_sample_depth_mm=2.0
)


@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1), turns=st.integers(0, 2))
def test_the_principal_box_is_the_smallest(seed, turns):
    rng = np.random.default_rng(seed)
    poses = hand_sweep(rng, 20, 40.0, turns)
    corners = np.concatenate([poses.apply(corner) for corner in GRID.corners_mm])

    def sizes(axes):
        return np.ptp(axes.inv().apply(corners), axis=0)

    axes = principal_axes(GRID, poses)
    box = np.prod(sizes(axes) + GRID.sample_spacing_mm)
    for candidate in [Rotation.identity(), sweep_axes(poses), *Rotation.random(300, rng=rng)]:
        # What rounding to whole voxels and the tie in favour of plain axes may cost.
        assert box <= 1.0002 * np.prod(sizes(candidate) + GRID.sample_spacing_mm)
    shape, world = (grid_around(GRID, poses, 0.5, way).shape for way in (axes, Rotation.identity()))
    assert np.prod(np.subtract(shape, 1.0)) <= np.prod(np.add(world, 1.0))
    # Right-handed, and no other order or sign of its axes is nearer to those of the mean image.
    away = sweep_axes(poses).inv() * axes
    assert away.magnitude() <= (away * Rotation.create_group("O")).magnitude().min() + 1e-12
