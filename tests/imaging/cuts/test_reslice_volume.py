"""Reslices of voxels: against brute force, voxels that hold nothing, any order in memory."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.volume import Volume
from speckle3d.imaging.cuts.planes import ReslicePlane
from speckle3d.imaging.cuts.reslice import reslice_volume


def index_of(volume, cut):
    """Fractional voxel indices of every pixel, shape (rows, columns, 3)."""
    rows, columns = np.indices(cut.shape)
    world = cut.world_from_mm(columns * cut.pixel_mm, rows * cut.pixel_mm)
    homogeneous = np.concatenate([world, np.ones((*cut.shape, 1))], axis=-1)
    return (homogeneous @ np.linalg.inv(volume.world_from_index).T)[..., :3]


def brute_force(volume, cut, held):
    """Every pixel by its eight neighbours, one at a time; those that hold nothing do not count."""
    out = np.full(cut.shape, np.nan)
    last = np.array(volume.shape) - 1
    for pixel, at in zip(np.ndindex(cut.shape), index_of(volume, cut).reshape(-1, 3), strict=True):
        if (at < -1e-6).any() or (at > last + 1e-6).any():
            continue
        total = weights = 0.0
        for corner in np.ndindex(2, 2, 2):
            voxel = np.floor(at + 1e-6).astype(int) + corner
            weight = np.prod(1 - np.minimum(np.abs(at - voxel), 1.0))
            if weight > 1e-5 and (voxel >= 0).all() and (voxel <= last).all() and held[tuple(voxel)]:
                total += weight * float(volume.voxels[tuple(voxel)])
                weights += weight
        if weights >= 0.5:
            out[pixel] = total / weights
    return out


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["uint8", "int16", "uint16", "float32"]),
    order=st.sampled_from("CF"),
    stated=st.booleans(),
)
def test_matches_brute_force_for_any_plane(seed, kind, order, stated):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 7, 3))
    voxels = np.asarray(rng.integers(0, 200, shape).astype(kind), order=order)
    held = rng.random(shape) > 0.25
    if kind == "float32" and not stated:
        voxels[~held] = np.nan
    elif not stated:
        held[:] = True
    placed = RigidTransform.from_components(rng.normal(0, 3, 3), Rotation.random(rng=rng))
    volume = Volume(voxels, tuple(rng.uniform(0.3, 1.2, 3)), placed)
    extent = (np.array(shape) - 1) * volume.spacing_mm
    centre = placed.apply(extent * rng.uniform(0.2, 0.8, 3))
    turned = Rotation.random(rng=rng)
    start = RigidTransform.from_components(centre, turned) * RigidTransform.from_translation([-2.0, -1.6, 0])
    cut = ReslicePlane(start, 4.0, 3.2, 0.21)
    got = reslice_volume(volume, cut, held.astype(np.uint8) if stated else None)
    expected = brute_force(volume, cut, held)
    # At half the weight the side that rounding takes is open.
    same = np.isnan(got) == np.isnan(expected)
    assert (~same).sum() <= 1
    np.testing.assert_allclose(got[same], expected[same], rtol=1e-5, atol=2e-3)
