import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.grid import ImageGrid
from speckle3d.matching.patches import PatchSettings, lay_patches


@given(
    vectors=st.integers(24, 300),
    samples=st.integers(200, 900),
    pitch=st.floats(0.15, 0.4),
    spacing=st.floats(0.03, 0.1),
    first=st.floats(-1.0, 6.0),
)
def test_whole_patches_tile_the_image_without_overlap(vectors, samples, pitch, spacing, first):
    grid = ImageGrid(vectors, samples, pitch, spacing, first)
    try:
        patches = lay_patches(grid)
    except InvalidInputError:
        assert grid.width_mm < 3.6 + pitch or grid.depth_mm < 2.0 + 2 * 3.0 + 3 * spacing
        return
    cover = np.zeros((vectors, samples), int)
    for v, s in patches.first:
        cover[v : v + patches.size[0], s : s + patches.size[1]] += 1
    assert cover.max() == 1
    assert cover.sum() == len(patches) * patches.size.prod()
    assert (patches.first >= 0).all()
    assert (patches.first + patches.size <= (vectors, samples)).all()
    sides = patches.size * patches.spacing_mm
    assert (np.abs(sides - [3.6, 3.0]) <= patches.spacing_mm / 2 + 1e-9).all()
    assert (first + patches.first[:, 1] * spacing >= 2.0 - 1e-9).all()
    expected = (patches.first + patches.first + patches.size - 1) / 2 * patches.spacing_mm + [0, first]
    np.testing.assert_allclose(patches.centre_mm, expected, atol=1e-9)


ROWS = ImageGrid(40, 700, 0.3, 0.05)
"""Eleven rows of patches, from 3.5 mm down."""


@pytest.mark.parametrize("depths", [(64.0, 100.0), (-30.0, 1.0), (3.5, 16.0), (20.0, 20.0)])
def test_depths_that_hold_less_than_half_of_the_rows_are_refused(depths):
    with pytest.raises(MismatchError):
        lay_patches(ROWS).between(np.array(depths))


def test_a_region_keeps_its_patches_and_rows():
    grid = ImageGrid(96, 1000, 0.3, 0.04)
    whole = lay_patches(grid)
    part = lay_patches(grid, PatchSettings(region="rectangle 0,8 15,20"))
    assert len(whole) > len(part) > part.inside.sum() > 0
    x, y = part.centre_mm[part.inside].T
    assert (x < 15).all()
    assert (y > 8).all()
    assert (y < 20).all()
    with pytest.raises(InvalidInputError):
        lay_patches(grid, PatchSettings(region="rectangle 0,8 15,9"))
