"""Reslices straight from frames: against brute force, and against scenes whose place is known."""

import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.cuts.planes import ReslicePlane, lateral_line, planes_from_first_frame
from speckle3d.imaging.cuts.reslice import reslice_frames

GRID = ImageGrid(vectors=9, samples=14, vector_pitch_mm=0.5, sample_spacing_mm=0.3, first_sample_depth_mm=0.7)
FINE = ImageGrid(
    vectors=61, samples=161, vector_pitch_mm=0.3, sample_spacing_mm=0.1, first_sample_depth_mm=2.0
)


def shaky_sweep(rng, frames, step_mm, shake_mm=0.2, shake_deg=3.0, reverse=True):
    """Irregular steps, some backwards, with jitter in all six directions."""
    z = np.cumsum(rng.uniform(-0.4 if reverse else 0.3, 1.6, frames) * step_mm)
    shake = rng.normal(0.0, shake_mm, (frames, 3)) * [1, 1, 0]
    turned = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(shake_deg), (frames, 3)))
    return RigidTransform.from_components(shake + z[:, None] * [0, 0, 1], turned)


def plane_along(poses, line_mm, pixel_mm=0.2):
    """Plane along the sweep at the poses of one mode."""
    (plane,) = planes_from_first_frame({"image": poses}, line_mm, pixel_mm).values()
    return plane


def pixel_points(plane):
    """Centre of every pixel in the world, shape (rows, columns, 3)."""
    rows, columns = plane.shape
    y, x = np.mgrid[:rows, :columns] * plane.pixel_mm
    local = np.stack([x, y, np.zeros_like(x)], axis=-1)
    return plane.world_from_plane.apply(local.reshape(-1, 3)).reshape(rows, columns, 3)


def image_points(grid, pose):
    """Centre of every sample in the world, shape (vector, sample, 3)."""
    i, j = np.mgrid[: grid.vectors, : grid.samples]
    x, y = i * grid.vector_pitch_mm, grid.first_sample_depth_mm + j * grid.sample_spacing_mm
    local = np.stack([x, y, np.zeros_like(x)], axis=-1)
    return pose.apply(local.reshape(-1, 3)).reshape(*i.shape, 3)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), max_distance_mm=st.floats(0.05, 2.0), moderate=st.booleans())
def test_matches_brute_force_for_any_plane(seed, max_distance_mm, moderate):
    rng = np.random.default_rng(seed)
    poses = shaky_sweep(rng, 7, 0.5)
    images = rng.normal(size=(7, GRID.vectors, GRID.samples)).astype(np.float32)
    images[rng.integers(7), :3, :3] = np.nan
    turned = Rotation.from_rotvec(rng.normal(0, 0.3, 3)) if moderate else Rotation.random(rng=rng)
    plane = ReslicePlane(RigidTransform.from_components(rng.uniform(-1, 3, 3), turned), 4.0, 3.0, 0.21)
    got = reslice_frames(images, GRID, poses, plane, max_distance_mm)
    expected, _ = oracles.between_images(
        images, GRID, poses, pixel_points(plane).reshape(-1, 3), max_distance_mm
    )
    # Distances are kept in single precision: 1e-7 of mm against gaps between frames of down to 1e-3 mm.
    np.testing.assert_allclose(got.ravel(), expected, atol=1e-3)


def test_tilted_bright_plane_appears_where_it_is():
    """A bright sheet through an irregular sweep: its crest in the reslice against its equation."""
    poses = shaky_sweep(np.random.default_rng(0), 80, 0.25)
    normal = np.array([0.1, 1.0, 0.35]) / np.linalg.norm([0.1, 1.0, 0.35])
    offset_mm = 10.0 * normal[1]
    sheet = [np.exp(-0.5 * ((image_points(FINE, p) @ normal - offset_mm) / 0.4) ** 2) for p in poses]
    plane = plane_along(poses, lateral_line(FINE, 9.0), 0.1)
    cut = reslice_frames(sheet, FINE, poses, plane, 1.5)  # 3 degrees of shake open gaps of a millimetre
    miss_mm = pixel_points(plane) @ normal - offset_mm
    full = np.isnan(cut).mean(axis=0) < 0.3
    # Before the first and after the last frame a pixel repeats the frame it projects onto: not measured here.
    full[:15] = full[-15:] = False
    weight = np.nan_to_num(cut[:, full]) ** 4
    crest_mm = (weight * miss_mm[:, full]).sum(axis=0) / weight.sum(axis=0)
    assert full.sum() > 80
    # Half the closest sampling step, the 0.1 mm pixel: blending frames must not move it more.
    assert np.abs(crest_mm).max() < 0.05
