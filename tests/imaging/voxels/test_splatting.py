"""Images given to voxels: against brute force, on any number of threads, at borders."""

from dataclasses import replace

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.grid import ImageGrid, ScanConversion
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.volume import compound

GRID = ImageGrid(
    vectors=13, samples=21, vector_pitch_mm=0.5, sample_spacing_mm=0.3, first_sample_depth_mm=0.7
)
SPLATS, RULES = ("nearest", "linear"), ("mean", "maximum", "latest", "weighted")
TYPES = ("uint8", "int16", "uint16", "float32")
FRAMES = 6


def any_scene(rng, kind):
    """Frames in any pose, some of them off the grid, and voxels of any size and orientation."""
    poses = RigidTransform.from_components(rng.normal(0, 2.0, (FRAMES, 3)), Rotation.random(FRAMES, rng=rng))
    corner = RigidTransform.from_components(rng.normal(0, 2.0, 3) - 2.0, Rotation.random(rng=rng))
    voxel_grid = VoxelGrid(tuple(rng.integers(1, 13, 3).tolist()), tuple(rng.uniform(0.2, 1.6, 3)), corner)
    if kind == "float32":
        images = rng.normal(size=(FRAMES, GRID.vectors, GRID.samples)).astype(np.float32)
        images[rng.random(images.shape) < 0.2] = np.nan
    else:
        limits = np.iinfo(kind)
        images = rng.integers(limits.min, limits.max + 1, (FRAMES, GRID.vectors, GRID.samples)).astype(kind)
    return images, poses, voxel_grid


def index_of(voxel_grid, poses, skew=0.0):
    """Fractional voxel of every sample, shape (n, vector, sample, 3)."""
    v, s = np.mgrid[: GRID.vectors, : GRID.samples]
    u, v, half = v * GRID.vector_pitch_mm, s * GRID.sample_spacing_mm, skew / 2
    x, y = np.cos(half) * u + np.sin(half) * v, np.sin(half) * u + np.cos(half) * v
    local = np.stack([x, GRID.first_sample_depth_mm + y, 0 * y], axis=-1).reshape(-1, 3)
    grid_from_world = voxel_grid.world_from_grid.inv()
    points = np.stack([(grid_from_world * pose).apply(local) for pose in poses])
    return (points / voxel_grid.spacing_mm).reshape(len(poses), GRID.vectors, GRID.samples, 3)


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    splat=st.sampled_from(SPLATS),
    rule=st.sampled_from(RULES),
    kind=st.sampled_from(TYPES),
    column_major=st.booleans(),
)
def test_matches_brute_force(seed, splat, rule, kind, column_major):
    rng = np.random.default_rng(seed)
    images, poses, voxel_grid = any_scene(rng, kind)
    skew, region = rng.uniform(-0.2, 0.2), rng.random((GRID.vectors, GRID.samples)) < 0.8
    weights = rng.integers(0, 3, FRAMES) * rng.uniform(0.5, 2, FRAMES)
    shares = np.broadcast_to(region, images.shape).astype(float)
    if rule == "weighted":
        shares = shares * weights[:, None, None]
    index = index_of(voxel_grid, poses, skew)
    expected = oracles.splat(images, index, voxel_grid.shape, splat, rule, shares)
    if np.isnan(expected).all():
        return
    source = [np.asfortranarray(image) for image in images] if column_major else images
    options = {"splat": splat, "rule": rule, "weights": weights, "region": region}
    volume = compound(
        source, replace(GRID, skew_rad=skew), poses, voxel_grid=voxel_grid, fill_radius=0, **options
    )
    # Sums in double precision, of levels up to 2^16; means in single.
    np.testing.assert_allclose(volume.voxels, expected, rtol=1e-6, atol=1e-9 * 2**16)
    np.testing.assert_array_equal(volume.state, ~np.isnan(expected))


def test_samples_on_a_border_belong_to_the_voxel_above():
    grid = ImageGrid(1, 9, 1.0, 0.5)
    voxel_grid = VoxelGrid((1, 4, 1), (1.0, 1.0, 1.0), RigidTransform.identity())
    for shift_mm in (0.0, 1e-12, -1e-12):
        pose = RigidTransform.from_translation([[0.0, shift_mm, 0.0]])
        volume = compound(np.arange(9, dtype=np.uint8)[None, None], grid, pose, voxel_grid=voxel_grid)
        # Samples at 0; 0.5 and 1; 1.5 and 2; 2.5 and 3; at 3.5 and 4 outside.
        np.testing.assert_array_equal(volume.voxels[0, :, 0], [0, 1.5, 3.5, 5.5])


def test_inputs_that_do_not_fit_are_errors():
    images, poses, voxel_grid = any_scene(np.random.default_rng(0), "uint8")
    scene = {"images": images, "grid": GRID, "world_from_image": poses, "voxel_grid": voxel_grid}
    for how, error in (
        ({"rule": "weighted"}, InvalidInputError),
        ({"backward_mm": 1.0, "splat": "linear"}, InvalidInputError),
        ({"images": [*images[:5], images[5].astype(np.int16)]}, MismatchError),
        ({"max_memory_gb": 1e-9}, InvalidInputError),
        ({"images": np.full(images.shape, np.nan)}, InsufficientDataError),
    ):
        with pytest.raises(error):
            compound(**scene | how)


def test_the_rule_plus_keeps_whole_levels_also_of_a_fans_picture():
    """Against the mean of the scan-converted images: pixel by pixel cut to whole levels."""
    fan = ImageGrid.of_fan(24, 90, 0.3, 40.0, (-0.4, 0.4))
    draw = ScanConversion(fan)
    rng = np.random.default_rng(2)
    images = np.stack([draw(rng.uniform(60, 200, (24, 90))) for _ in range(3)])
    poses = RigidTransform.from_translation([[0.0, 0.0, z] for z in (0.0, 0.1, 0.2)])
    mean, plus = (
        compound(images, draw.grid, poses, 0.9, rule=rule, fill_radius=0) for rule in ("mean", "plus")
    )
    np.testing.assert_array_equal(plus.state, mean.state)
    loss = (mean.voxels - plus.voxels)[plus.state > 0]
    # Places are rounded to 2^-14 voxel, each pixel loses less than a level.
    assert loss.size > 0.3 * plus.state.size
    assert 0 < loss.mean() < 4
    assert (plus.voxels == np.rint(plus.voxels))[plus.state > 0].all()
