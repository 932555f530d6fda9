from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid, ScanConversion
from speckle3d.imaging.cuts.planes import lateral_line
from speckle3d.imaging.measures.belonging import belonging_of

CONVEX = ImageGrid.of_fan(97, 401, 0.1, 60.0, tuple(np.deg2rad((-30.0, 30.0))))
SECTOR = ImageGrid.of_fan(65, 301, 0.2, 0.0, tuple(np.deg2rad((-45.0, 45.0))), 2.0)


@pytest.mark.parametrize("grid", [CONVEX, SECTOR, ImageGrid(20, 30, 0.3, 0.1, 2.0, 0.03)])
def test_places_and_samples_are_inverse(grid):
    samples = np.random.default_rng(0).uniform(1, 19, (50, 2))
    np.testing.assert_allclose(grid.sample_at(grid.mm(*samples.T)), samples, atol=1e-9)


def test_image_of_a_curved_array_begins_at_its_top_left():
    # The outermost lines begin highest, the middle one ends lowest.
    top, left = 60.0 * np.cos(np.deg2rad(30.0)), -100.0 * np.sin(np.deg2rad(30.0))
    np.testing.assert_allclose(CONVEX.mm(48, 0), [-left, 60.0 - top], atol=1e-9)
    np.testing.assert_allclose(CONVEX.corners_mm[2, :2], [-2 * left, 100.0 - top], atol=1e-9)
    np.testing.assert_allclose(CONVEX.centre_mm, [-left, 80.0 - top, 0.0], atol=1e-9)
    assert CONVEX.vector_pitch_mm == pytest.approx(80.0 * np.deg2rad(60.0) / 96)


def test_the_lowest_point_of_a_fan_is_in_its_image():
    lowest = np.append(CONVEX.mm(48, 400), 0.0)
    assert lowest[1] > CONVEX.depth_mm + 7.0
    place = belonging_of(lowest[None], CONVEX, RigidTransform.from_translation(np.zeros((1, 3))))
    assert place.gap_mm == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(lateral_line(CONVEX, lowest[0])[1], lowest)


def test_lines_beyond_the_horizon_are_refused():
    with pytest.raises(InvalidInputError, match="90 degrees"):
        ImageGrid.of_fan(10, 100, 0.1, 10.0, (-1.6, 1.6))


ASIDE = replace(SECTOR, fan=replace(SECTOR.fan, apex_mm=(20.0, -5.0)))
"""A fan whose picture does not begin at the origin of its image."""


@pytest.mark.parametrize("grid", [CONVEX, SECTOR, ASIDE])
def test_a_disc_is_drawn_where_it_is(grid):
    v, s = np.indices((grid.vectors, grid.samples))
    place = grid.mm(v, s)
    centre = grid.mm(0.7 * grid.vectors, 0.5 * grid.samples)
    convert = ScanConversion(grid)
    picture = convert(np.exp(-0.5 * ((place - centre) ** 2).sum(axis=2) / 2.0**2))
    pixels = convert.grid.mm(*np.indices(picture.shape))
    inside = np.isfinite(picture)
    centroid = (picture[inside][:, None] * pixels[inside]).sum(axis=0) / picture[inside].sum()
    np.testing.assert_allclose(centroid, centre, atol=0.02)
    # The share of the box that a fan fills, by its area.
    fan = 0.5 * np.ptp(grid.angle_rad([0, grid.vectors - 1]))
    fan *= np.diff(np.square(grid.fan.radius_mm + np.array([grid.first_sample_depth_mm, grid.depth_mm])))[0]
    low, high = grid.corners_mm[0], grid.corners_mm[2]
    assert inside.mean() == pytest.approx(fan / np.prod((high - low)[:2]), rel=0.02)
