"""Regions of the image: sample by sample, and as written on the command line."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid, Region
from speckle3d.study.scenes.voxels import masked_part

GRID = ImageGrid(
    vectors=31, samples=57, vector_pitch_mm=0.3, sample_spacing_mm=0.1, first_sample_depth_mm=0.7
)


X, Y = np.meshgrid(0.3 * np.arange(31), 0.7 + 0.1 * np.arange(57), indexing="ij")


def _text(pairs):
    return " ".join(f"{float(x)!r},{float(y)!r}" for x, y in pairs)


@settings(max_examples=10)
@given(
    apex=st.tuples(st.floats(3, 6), st.floats(-3, 0.5)),
    angles=st.tuples(st.floats(-89, -5), st.floats(5, 89)),
    radii=st.tuples(st.floats(0, 3), st.floats(9, 25)),
)
def test_fan_is_between_its_angles_and_radii(apex, angles, radii):
    angle, radius = np.degrees(np.arctan2(X - apex[0], Y - apex[1])), np.hypot(X - apex[0], Y - apex[1])
    past = [angle - angles[0], angles[1] - angle, 100 * (radius - radii[0]), 100 * (radii[1] - radius)]
    least = np.min(past, axis=0)
    # Samples on a side itself, to a millionth of the fan, are a matter of rounding.
    sure = np.abs(least) > 3e-3
    mask = Region("fan " + _text([apex, angles, radii])).mask(GRID)
    np.testing.assert_array_equal(mask[sure], least[sure] > 0)


def test_a_polygon_with_the_corners_of_a_rectangle_is_that_rectangle():
    masks = [Region(text).mask(GRID) for text in ("polygon 1,2 5,2 5,4.05 1,4.05", "rectangle 1,2 5,4.05")]
    np.testing.assert_array_equal(*masks)


def test_the_part_of_the_images_that_a_region_needs():
    grid = ImageGrid(31, 57, 0.3, 0.1, 0.7, 0.06)
    region = Region("fan 4.5,-5 -20,25 7,9.5")
    part = masked_part(grid, region.mask(grid))
    inside = np.argwhere(region.mask(grid))
    first, last = inside.min(axis=0), inside.max(axis=0)
    assert (part.vectors, part.samples) == tuple(last - first + 1)
    corners = np.array([[*first, 1], [last[0], first[1], 1], [*last, 1], [first[0], last[1], 1]])
    in_image = corners @ grid.image_from_sample[:3].T
    np.testing.assert_allclose(part.corners_mm, in_image, atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "rectangle 1,1 2;2",
        "fan 0,0 9,30 2,1",
    ],
)
def test_what_is_no_region_is_refused_in_one_line(text):
    with pytest.raises(InvalidInputError) as error:
        Region(text)
    assert "\n" not in str(error.value)
