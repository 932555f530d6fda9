"""What stands still in the images: where it is found, and that nothing of it reaches the rest."""

import numpy as np
import pytest

from speckle3d.matching.intensity import Echo
from speckle3d.matching.matcher import standing_samples

FRAMES, SHAPE = 16, (24, 200)


@pytest.mark.parametrize("is_bmode", [True, False])
def test_what_no_frame_changes_is_found_where_it_is_and_nowhere_else(is_bmode):
    rng, echoes = np.random.default_rng(2), []
    for _ in range(FRAMES):
        grey = rng.integers(0, 200, SHAPE).astype(np.float32)
        echo = (rng.normal(size=SHAPE) + 1j * rng.normal(size=SHAPE)).astype(np.complex64)
        # Text in a compressed video flickers.
        grey[5:9, 40:60], echo[5:9, 40:60] = rng.uniform(170, 255, (4, 20)), echo[5:9, 40:60] + 6.0
        echoes.append(Echo(grey, None) if is_bmode else Echo(np.abs(echo) ** 2, echo))
    expected = np.zeros(SHAPE, bool)
    expected[5:9, 40:60] = True
    # Speckle stands by chance in 3 of 100,000 samples.
    assert np.count_nonzero(standing_samples(echoes) != expected) <= 1
