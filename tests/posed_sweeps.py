"""Hand-held sweeps somewhere in the world, to and fro, the probe perhaps turned between passes."""

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid

GRID = ImageGrid(
    vectors=41, samples=60, vector_pitch_mm=0.5, sample_spacing_mm=0.4, first_sample_depth_mm=2.0
)
HALF_TURN = Rotation.from_rotvec([0.0, np.pi, 0.0])

KINDS = st.sampled_from([(1, 1, False), (1, 25, False), (2, 20, False), (2, 20, True), (3, 12, False)])
"""Passes, frames of each, and whether the probe is turned."""


def sweep(rng, frames, passes=1, turned=False):
    """A hand-held sweep somewhere in the world, perhaps to and fro, the probe perhaps turned between."""
    there = np.outer(np.linspace(0.0, 40.0, frames), [rng.uniform(-0.4, 0.4), rng.uniform(-0.2, 0.2), 1.0])
    moved = np.concatenate([there[:: 1 - 2 * (number % 2)] for number in range(passes)])
    moved += np.repeat(rng.normal(0.0, 2.0, (passes, 3)), frames, axis=0) + rng.normal(0.0, 0.2, moved.shape)
    shaken = Rotation.from_rotvec(rng.normal(0.0, 0.08, moved.shape))
    poses = RigidTransform.from_components(moved, shaken)
    if turned:
        middle = RigidTransform.from_translation([20.0, 0.0, 0.0])
        back = poses[frames:] * (middle * RigidTransform.from_rotation(HALF_TURN))
        poses = RigidTransform.concatenate([poses[:frames], back])
    somewhere = RigidTransform.from_components(rng.normal(0.0, 50.0, 3), Rotation.random(rng=rng))
    return somewhere * poses, somewhere.rotation


def corners_in(voxels, poses):
    """Corners of all images in voxels, shape (n, 3)."""
    corners = np.concatenate([poses.apply(corner) for corner in GRID.corners_mm])
    return voxels.world_from_grid.inv().apply(corners) / voxels.spacing_mm
