import numpy as np
import pytest

from speckle3d.app.sweep.screen import MOST_ROWS, ScreenImages
from speckle3d.core.sweep import BModeSettings, ImageGrid, Sweep
from speckle3d.study.images import GreyImages


def test_echoes_are_shown_log_compressed_with_rows_pooled(sweep):
    images, grey = ScreenImages(sweep), GreyImages(sweep, 45.0)
    shown = images.image(7, 45)
    pool = 2
    rows = grey.shape[2] // pool
    assert shown.shape == (rows, grey.shape[1])
    assert rows <= MOST_ROWS
    expected = grey[7][:, : rows * pool].reshape(-1, rows, pool).mean(axis=2).T
    np.testing.assert_allclose(shown, expected, atol=1.01)


def test_the_picture_reaches_half_a_sample_beyond_the_outermost(sweep):
    images = ScreenImages(sweep)
    left, top, width, height = images.extent_mm()
    grid = GreyImages(sweep, 60.0).grid
    assert left == -grid.vector_pitch_mm / 2
    assert width == pytest.approx(grid.width_mm + grid.vector_pitch_mm)
    assert top == pytest.approx(grid.first_sample_depth_mm - grid.sample_spacing_mm / 2)
    # An odd row at the bottom is not shown.
    assert top + height == pytest.approx(grid.depth_mm, abs=1.01 * grid.sample_spacing_mm)


@pytest.mark.parametrize("full_scale", [255.0, 63.0])
def test_bmode_is_shown_as_it_is_stored(full_scale):
    frames = np.random.default_rng(3).integers(0, int(full_scale) + 1, (2, 9, 50)).astype(np.uint8)
    sweep = Sweep(frames, ImageGrid(9, 50, 0.3, 0.1), BModeSettings(60.0, full_scale), np.arange(2) / 25)
    images = ScreenImages(sweep)
    assert not images.of_echoes
    np.testing.assert_allclose(images.image(1), frames[1].T * (255.0 / full_scale), atol=1.0)
