"""Reduced images of a sweep."""

import numpy as np
import pytest

from speckle3d.core.grid import ImageGrid
from speckle3d.correction.crossing.stack import ImageStack

GRID = ImageGrid(8, 64, 0.3, 0.0115, 0.5)


def test_pools_intensity_before_the_logarithm():
    stack = ImageStack(GRID)
    intensity = np.random.default_rng(1).exponential(size=(8, 64)).astype(np.float32)
    stack.keep(0, intensity)
    expected = 10 * np.log10(intensity[:, :60].reshape(8, 2, 30).mean(axis=2))
    # float16 has 11 bits: steps of 0.016 dB at 20 dB.
    np.testing.assert_allclose(stack.images(1)[0], expected, atol=0.016)
    assert stack.grid.sample_spacing_mm == pytest.approx(30 * 0.0115)
    assert stack.grid.first_sample_depth_mm == pytest.approx(0.5 + 14.5 * 0.0115)
