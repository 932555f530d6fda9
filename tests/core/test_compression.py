"""Dynamic ranges that nobody says, by speckle of one look and of several."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter

from speckle3d.core.images import USUAL_DB, estimate_dynamic_range

PITCH_MM, SPACING_MM = 0.3, 0.09


def looks(seed, count=1):
    """Intensity of fully developed speckle in six frames, mean of some looks."""
    rng = np.random.default_rng(seed)
    shape = (count, 6, 96, 400)
    field = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    field = gaussian_filter(field.real, (0, 0, 0.6, 0.9)) + 1j * gaussian_filter(field.imag, (0, 0, 0.6, 0.9))
    return (np.abs(field) ** 2).mean(axis=0)


def grey_levels(intensity, range_db):
    """Grey levels, the mean 20 dB below white."""
    level = 1 + (10 * np.log10(intensity / intensity.mean()) - 20) / range_db
    return np.rint(255 * np.clip(level, 0, 1)).astype(np.uint8)


def estimate(frames):
    return estimate_dynamic_range(frames, PITCH_MM, SPACING_MM)


@pytest.mark.parametrize("range_db", [40.0, 60.0, 80.0])
def test_one_look_tells_the_range(range_db):
    estimate_db, sigma = estimate(grey_levels(looks(1), range_db))
    # At 40 dB 10.2 %; medians of whole grey levels move it by 1 % where rounding differs.
    assert abs(estimate_db / range_db - 1) < 0.12
    assert abs(estimate_db - range_db) < 2 * sigma < 0.2 * range_db


@pytest.mark.parametrize("range_db", [45.0, 60.0, 75.0])
def test_smoothing_and_two_looks_widen_it_and_do_not_shift_it(range_db):
    _, single_sigma = estimate(grey_levels(looks(2), range_db))
    smooth = uniform_filter(grey_levels(looks(2), range_db).astype(float), (0, 3, 3)).astype(np.uint8)
    for frames in (smooth, grey_levels(looks(3, 2), range_db)):
        estimate_db, sigma = estimate(frames)
        assert sigma > 1.5 * single_sigma
        assert abs(estimate_db - range_db) < 2.5 * sigma
    assert abs(estimate(smooth)[0] / USUAL_DB - 1) < 0.35


def test_images_too_small_to_tell_are_asked_for():
    assert estimate_dynamic_range(np.zeros((3, 5, 4), np.uint8), 0.1, 0.1) is None
    assert estimate(np.zeros((3, 96, 400), np.uint8)) is None
