"""Echoes that stay where they are in the image."""

from dataclasses import replace

import numpy as np
import pytest
from sweep_examples import RF

from speckle3d.core.sweep import BModeSettings, ImageGrid, Sweep
from speckle3d.matching.inplane import InPlaneSettings
from speckle3d.matching.intensity import IntensitySettings
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchSettings
from speckle3d.matching.standing import standing_share

FRAMES = range(5)


def sweep_of(frames):
    grid = ImageGrid(frames.shape[1], frames.shape[2], 0.3, RF.sample_spacing_mm, 0.0)
    return Sweep(frames.astype(np.float32), grid, RF, np.arange(len(frames)) / 25)


def share_of(sweep):
    matcher = FrameMatcher(sweep, IntensitySettings(), PatchSettings(), InPlaneSettings())
    return standing_share(sweep, matcher, FRAMES)


@pytest.fixture(scope="module")
def fresh():
    """Five frames of white noise, which the matcher's band-pass makes speckle of."""
    return np.random.default_rng(0).standard_normal((len(FRAMES), 36, 900))


def pattern():
    return np.random.default_rng(1).standard_normal((36, 900))


@pytest.mark.parametrize("over_signal_db", [-10.0, 0.0])
def test_it_is_clutters_share_of_the_power(fresh, over_signal_db):
    power = 10 ** (over_signal_db / 10)
    share = share_of(sweep_of(fresh + np.sqrt(power) * pattern()))
    assert share.shape == (15,)
    assert np.median(share) == pytest.approx(power / (1 + power), abs=0.02)


def test_nothing_in_common_is_none(fresh):
    assert abs(np.median(share_of(sweep_of(fresh)))) < 0.01


def test_gain_does_not_matter(fresh):
    steady = fresh + 0.5 * pattern()
    flickering = steady * np.array([1.0, 0.3, 2.0, 0.7, 1.5])[:, None, None]
    np.testing.assert_allclose(share_of(sweep_of(flickering)), share_of(sweep_of(steady)), atol=1e-5)


def test_structure_that_moves_in_the_image_does_not_stand_still(fresh):
    """By a few samples from frame to frame, as a hand wanders: a quarter of a wavelength is enough."""
    wandering = np.stack([np.roll(pattern(), 3 * k, axis=1) for k in FRAMES])
    assert np.median(share_of(sweep_of(fresh + wandering))) < 0.1


def test_frames_that_see_the_same_by_chance_do_not_count(fresh):
    back = fresh.copy()
    back[4] = back[0]
    assert abs(np.median(share_of(sweep_of(back)))) < 0.03


def test_half_of_the_depth_shows_as_half_of_the_patches(fresh):
    deep = np.where(np.arange(900) >= 450, 1.0, 0.0)
    share = share_of(sweep_of(fresh + deep * pattern()))
    assert np.mean(share > 0.4) == pytest.approx(0.4, abs=0.15)
    assert np.mean(share < 0.1) == pytest.approx(0.5, abs=0.15)


def test_grey_levels_will_do(fresh):
    levels = np.clip(180 + 40 * (fresh + pattern()), 1, 255)
    sweep = replace(sweep_of(levels), signal=BModeSettings(60.0), grid=ImageGrid(36, 900, 0.3, 0.02, 0.0))
    matcher = FrameMatcher(sweep, IntensitySettings(), PatchSettings(), InPlaneSettings())
    assert np.median(standing_share(sweep, matcher, FRAMES)) > 0.2
    silent = replace(sweep, frames=np.zeros_like(sweep.frames))
    assert np.isnan(standing_share(silent, matcher, FRAMES)).all()
