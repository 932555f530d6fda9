"""Surfaces of bodies whose size is known by formula."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.volume import Volume
from speckle3d.imaging.surface import (
    measures_of,
    surface_of,
)

STEP_MM = 0.25
PLACED = RigidTransform.from_components([3.0, -2.0, 5.0], Rotation.from_euler("ZYX", [0.4, -0.2, 0.3]))


def ball(radius_mm=4.0, shape=(41, 43, 45), spacing=(0.25, 0.25, 0.25), placed=PLACED, order="F"):
    """A ball's depth, in voxels' centres, and its centre in the world."""
    middle = (np.array(shape) - 1) / 2 * spacing
    at = np.stack(
        np.meshgrid(*(np.arange(n) * s for n, s in zip(shape, spacing, strict=True)), indexing="ij"), -1
    )
    depth = radius_mm - np.linalg.norm(at - middle, axis=-1)
    return Volume(np.asarray(depth, np.float32, order=order), spacing, placed), placed.apply(middle)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("spacing", [(0.25, 0.25, 0.25), (0.3, 0.25, 0.2)])
def test_a_balls_surface_lies_on_it_and_faces_outwards(order, spacing):
    volume, centre = ball(spacing=spacing, order=order)
    surface = surface_of(volume, 0.0)
    away = np.linalg.norm(surface.vertices_mm - centre, axis=1)
    np.testing.assert_allclose(away, 4.0, atol=0.02)
    middles = surface.vertices_mm[surface.triangles].mean(axis=1) - centre
    assert (np.einsum("ij,ij->i", surface.normals_mm2, middles) > -1e-12).all()
    assert not len(surface.open_edges())
    assert surface.volume_mm3 == pytest.approx(4 / 3 * np.pi * 64, rel=0.01)
    assert surface.area_mm2 == pytest.approx(4 * np.pi * 16, rel=0.01)


def test_what_is_darker_inside_faces_outwards_too():
    volume, _ = ball()
    dark = Volume(-volume.voxels, volume.spacing_mm, volume.world_from_grid)
    assert surface_of(dark, 0.0, "below").volume_mm3 == pytest.approx(
        surface_of(volume, 0.0).volume_mm3, rel=1e-4
    )


def test_where_the_sweep_ends_the_surface_stays_open():
    volume, _ = ball()
    voxels = volume.voxels.copy()
    voxels[:20] = np.nan
    cut = surface_of(Volume(voxels, volume.spacing_mm, PLACED), 0.0)
    found = measures_of(cut)
    assert found.volume_mm3 is None
    # The rim of half a ball.
    assert found.open_mm == pytest.approx(2 * np.pi * 4.0, rel=0.05)
    assert found.area_mm2 == pytest.approx(2 * np.pi * 16.0, rel=0.05)


def test_derivatives_of_area_and_volume_are_those_of_moved_vertices():
    volume, _ = ball(2.0, (21, 21, 21))
    surface = surface_of(volume, 0.0)
    rng = np.random.default_rng(0)
    move = rng.normal(size=surface.vertices_mm.shape)
    ahead, behind = (
        type(surface)(surface.vertices_mm + sign * 1e-5 * move, surface.triangles) for sign in (1, -1)
    )
    area = (ahead.area_mm2 - behind.area_mm2) / 2e-5
    content = (ahead.volume_mm3 - behind.volume_mm3) / 2e-5
    assert (surface.area_gradient() * move).sum() == pytest.approx(area, rel=1e-5)
    assert (surface.volume_gradient() * move).sum() == pytest.approx(content, rel=1e-5)
