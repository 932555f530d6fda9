"""Surfaces of bodies whose size is known by formula."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.poses import PoseErrors
from speckle3d.core.volume import Volume
from speckle3d.imaging.measures.belonging import belonging_of
from speckle3d.imaging.measures.surface import (
    largest_part,
    measures_of,
    smooth_surface,
    surface_of,
    surfaces_of_labels,
)

POSE = RigidTransform.from_components([3.0, -2.0, 5.0], Rotation.from_euler("ZYX", [0.4, -0.2, 0.3]))


def ball(radius_mm=4.0, shape=(41, 43, 45), spacing=(0.25, 0.25, 0.25), pose=POSE, order="F"):
    """A ball's depth, in voxels' centres, and its centre in the world."""
    middle = (np.array(shape) - 1) / 2 * spacing
    at = np.stack(
        np.meshgrid(*(np.arange(n) * s for n, s in zip(shape, spacing, strict=True)), indexing="ij"), -1
    )
    depth = radius_mm - np.linalg.norm(at - middle, axis=-1)
    return Volume(np.asarray(depth, np.float32, order=order), spacing, pose), pose.apply(middle)


def test_a_balls_surface_lies_on_it_and_faces_outwards():
    volume, centre = ball(spacing=(0.3, 0.25, 0.2))
    surface = surface_of(volume, 0.0)
    away = np.linalg.norm(surface.vertices_mm - centre, axis=1)
    np.testing.assert_allclose(away, 4.0, atol=0.02)
    middles = surface.vertices_mm[surface.triangles].mean(axis=1) - centre
    assert (np.einsum("ij,ij->i", surface.normals_mm2, middles) > -1e-12).all()
    assert not len(surface.open_edges())
    assert surface.volume_mm3 == pytest.approx(4 / 3 * np.pi * 64, rel=0.01)
    assert surface.area_mm2 == pytest.approx(4 * np.pi * 16, rel=0.01)


def test_where_the_sweep_ends_the_surface_stays_open():
    volume, _ = ball()
    voxels = volume.voxels.copy()
    voxels[:20] = np.nan
    cut = surface_of(Volume(voxels, volume.spacing_mm, POSE), 0.0)
    measures = measures_of(cut)
    assert measures.volume_mm3 is None
    # The rim of half a ball.
    assert measures.open_mm == pytest.approx(2 * np.pi * 4.0, rel=0.05)
    assert measures.area_mm2 == pytest.approx(2 * np.pi * 16.0, rel=0.05)


def two_labels():
    """Two boxes of labels 2 and 5, one of them at the grid's border."""
    voxels = np.zeros((12, 10, 11), np.uint8)
    voxels[2:6, 2:7, 2:8] = 2
    voxels[8:, 3:6, 3:6] = 5
    return Volume(voxels, (0.5, 0.5, 1.0), POSE)


def test_labels_have_a_surface_each_open_where_the_grid_ends():
    surfaces = surfaces_of_labels(two_labels())
    assert list(surfaces) == [2, 5]
    assert surfaces[2].fields["label"] == "2"
    whole, cut = (measures_of(surfaces[label]) for label in (2, 5))
    # A box of 4 x 5 x 6 voxels of 0.25 mm3, its edges cut off by half a voxel.
    assert 0.8 * 30.0 < whole.volume_mm3 < 30.0
    assert whole.open_mm == 0.0
    assert cut.volume_mm3 is None
    assert cut.open_mm > 0.0


def test_smoothing_evens_noise_out_and_keeps_the_volume():
    volume, centre = ball(4.0)
    rng = np.random.default_rng(0)
    noisy = Volume(volume.voxels + rng.normal(0, 0.1, volume.shape).astype(np.float32), (0.25,) * 3, POSE)
    rough = largest_part(surface_of(noisy, 0.0))
    smooth = smooth_surface(rough, 20)
    away = [np.std(np.linalg.norm(part.vertices_mm - centre, axis=1)) for part in (rough, smooth)]
    assert away[1] < 0.7 * away[0]
    assert smooth.volume_mm3 == pytest.approx(rough.volume_mm3, rel=0.01)
    open_ = surface_of(Volume(volume.voxels[20:], (0.25,) * 3, POSE), 0.0)
    border = open_.open_edges().ravel()
    np.testing.assert_array_equal(smooth_surface(open_, 5).vertices_mm[border], open_.vertices_mm[border])


def test_errors_of_volume_and_area_are_those_of_repeated_draws():
    """A ball swept along z, every vertex moved with its frame: first order is what is claimed."""
    grid = ImageGrid(51, 51, 0.2, 0.2)
    poses = RigidTransform.from_translation(np.column_stack([np.zeros((41, 2)), 0.25 * np.arange(41)]))
    volume, _ = ball(3.0, (21, 21, 21), (0.5, 0.5, 0.5), RigidTransform.identity())
    surface = surface_of(volume, 0.0)
    rng = np.random.default_rng(4)
    along = np.linspace(0, 1, 41)[None, :, None]
    factors = rng.normal(size=(5, 1, 6)) * [0.3, 0.3, 0.6, 0.02, 0.02, 0.02] * along
    errors = PoseErrors(factors, poses, grid.centre_mm)
    measures = measures_of(surface, errors, grid)
    near = belonging_of(surface.vertices_mm, grid, poses)
    arms = surface.vertices_mm[:, None] - poses.apply(grid.centre_mm)[near.frames]
    shifts = factors[:, near.frames, :3] + np.cross(factors[:, near.frames, 3:], arms)
    shifts = (shifts * near.weights[..., None]).sum(axis=2)
    sizes = []
    for normal in rng.standard_normal((400, 5)):
        vertices = surface.vertices_mm + np.einsum("m,mka->ka", normal, shifts)
        shape = type(surface)(vertices, surface.triangles)
        sizes.append([shape.volume_mm3, shape.area_mm2])
    # 400 draws: a deviation to 3.5 %, three times that.
    sigmas = [measures.volume_sigma_mm3, measures.area_sigma_mm2]
    np.testing.assert_allclose(np.std(sizes, axis=0), sigmas, rtol=0.1)


def test_without_a_surface_there_is_an_error():
    volume, _ = ball()
    with pytest.raises(InvalidInputError):
        surface_of(volume, 99.0)
    with pytest.raises(InsufficientDataError):
        surface_of(Volume(volume.voxels[:1], volume.spacing_mm, POSE), -2.0)
