"""Reslices straight from frames: against brute force, and against scenes whose place is known."""

import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.cuts.planes import plane_cut
from speckle3d.imaging.cuts.reslice import reslice_at

GRID = ImageGrid(vectors=9, samples=14, vector_pitch_mm=0.5, sample_spacing_mm=0.3, first_sample_depth_mm=0.7)


def shaky_sweep(rng, frames, step_mm, shake_mm=0.2, shake_deg=3.0, reverse=True):
    """Irregular steps, some backwards, with jitter in all six directions."""
    z = np.cumsum(rng.uniform(-0.4 if reverse else 0.3, 1.6, frames) * step_mm)
    shake = rng.normal(0.0, shake_mm, (frames, 3)) * [1, 1, 0]
    turn = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(shake_deg), (frames, 3)))
    return RigidTransform.from_components(shake + z[:, None] * [0, 0, 1], turn)


def pixel_points(plane):
    """Centre of every pixel in the world, shape (rows, columns, 3)."""
    rows, columns = plane.shape
    y, x = np.mgrid[:rows, :columns] * plane.pixel_mm
    local = np.stack([x, y, np.zeros_like(x)], axis=-1)
    return plane.world_from_picture.apply(local.reshape(-1, 3)).reshape(rows, columns, 3)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), max_distance_mm=st.floats(0.05, 2.0), moderate=st.booleans())
def test_matches_brute_force_for_any_plane(seed, max_distance_mm, moderate):
    rng = np.random.default_rng(seed)
    poses = shaky_sweep(rng, 7, 0.5)
    images = rng.normal(size=(7, GRID.vectors, GRID.samples)).astype(np.float32)
    images[rng.integers(7), :3, :3] = np.nan
    turn = Rotation.from_rotvec(rng.normal(0, 0.3, 3)) if moderate else Rotation.random(rng=rng)
    pose = RigidTransform.from_components(rng.uniform(-1, 3, 3), turn)
    plane = plane_cut(pose, (0.0, 0.0), (4.0, 3.0), 0.21)
    (cut,) = reslice_at(images, GRID, [(poses, plane)], max_distance_mm)
    expected, _ = oracles.between_images(
        images, GRID, poses, pixel_points(plane).reshape(-1, 3), max_distance_mm
    )
    # Distances are kept in single precision: 1e-7 of mm against gaps between frames of down to 1e-3 mm.
    np.testing.assert_allclose(cut.ravel(), expected, atol=1e-3)
