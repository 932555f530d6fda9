"""Averaged frames shorten a sweep, and are found; single ones are not taken for them."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from accuracy_set import INDEPENDENT, SHEET
from scipy import ndimage
from spoiled_images import with_frames
from sweep_examples import frames_of

from speckle3d.config import Config
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.examine.images import examine_echoes
from speckle3d.io.load import load_sweep
from speckle3d.matching.frames import match_sweep
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.schedule import PairSchedule
from speckle3d.motion.tissue import averaging_loss, structure_openness
from speckle3d.sheet_curves import data_sheet_curves
from speckle3d.simulation.receiver import received
from speckle3d.tracking import track


def b_mode(sweep):
    """Grey levels of a sweep of echoes, in memory."""
    images = received(sweep, dynamic_range_db=60.0)
    return replace(images, frames=frames_of(images))


@pytest.fixture(scope="module")
def grey(sweep):
    """B-mode of the shipped phantom."""
    return b_mode(sweep.part(0, 64))


def frame_means(sweep, count):
    """Each frame the mean of some, as scanners in persistence show them."""
    sums = np.cumsum(sweep.frames.astype(float), axis=0)
    return with_frames(sweep, np.rint((sums[count:] - sums[:-count]) / count), range(count, len(sums)))


def matches_of(sweep):
    matcher = FrameMatcher(sweep, curves=data_sheet_curves(SHEET, sweep))
    return match_sweep(sweep, matcher, PairSchedule(Config().trajectory))


def first_frames_loss(matches, count):
    return averaging_loss(matches.table.where(matches.table.second < count), matches.features)


def test_frames_of_one_moment_each_are_not_doubted(grey):
    matches = matches_of(grey)
    assert [first_frames_loss(matches, count) for count in (8, 16, 64)] == [0.0, 0.0, 0.0]
    assert structure_openness(matches.texture) == 0.0


@pytest.mark.slow
@pytest.mark.skipif(not INDEPENDENT.is_dir(), reason="no sweeps of another physics at hand")
def test_an_even_hand_over_tissue_is_not_doubted():
    matches = matches_of(b_mode(load_sweep(INDEPENDENT / "tissue_reverse.h5")))
    assert averaging_loss(matches.table, matches.features) == 0.0


def sharpened(frame):
    return frame + 2.0 * (frame - ndimage.gaussian_filter(frame, (1, 3)))


@pytest.mark.parametrize(
    ("process", "claims"),
    [
        (np.copy, (0.1, 0.13)),
        (sharpened, (0.2, 0.3)),
        (partial(ndimage.maximum_filter, size=3), (0.15, 0.25)),
    ],
)
def test_processed_images_claim_by_how_far_their_grey_levels_are_from_speckles(grey, process, claims):
    frames = [np.clip(np.rint(process(frame.astype(float))), 0, 255) for frame in grey.frames[:40]]
    sweep = replace(with_frames(grey.part(0, 40), frames), frames=np.array(frames, np.uint8))
    tracking, centre = track(sweep, data_sheet_curves(SHEET, sweep)), sweep.grid.centre_mm
    true = (sweep.truth[0].inv() * sweep.truth).apply(centre)[-1, 2]
    length = tracking.image.apply(centre)[-1, 2]
    claim = np.sqrt(tracking.covariance[-1, 2, 2]) / abs(length)
    assert claims[0] < claim < claims[1]
    assert abs(length) == pytest.approx(abs(true), rel=0.1)
    assert any(doubt.suspect == "filtered images" for doubt in tracking.doubts) == (process is not np.copy)


@pytest.mark.parametrize(("dark_db", "factor"), [(8.2, 1.0), (0.7 * 5.0, 1.0), (0.4 * 5.0, 2.0)])
def test_filtered_speckle_is_not_taken_for_structure(dark_db, factor):
    texture = SimpleNamespace(grey_spread_db=lambda: np.array([dark_db, 5.0]))
    assert structure_openness(texture) == pytest.approx(np.log(factor))


def test_images_black_for_the_most_part_leave_lengths_open(grey):
    dark = np.maximum(grey.frames - np.quantile(grey.frames, 0.8), 0.0).astype(np.uint8)
    assert 0.0 < structure_openness(matches_of(replace(grey, frames=dark)).texture) < np.inf


@pytest.mark.parametrize("count", [2, 3])
def test_means_of_frames_are_refused(grey, count):
    sweep = frame_means(grey, count)
    assert first_frames_loss(matches_of(sweep), 16) > 0.0
    with pytest.raises(InsufficientDataError):
        track(sweep, data_sheet_curves(SHEET, sweep))


def test_a_range_that_curves_state_is_taken_for_an_estimated_one(grey):
    short = grey.part(0, 24)
    curves = data_sheet_curves(SHEET, short)
    range_estimate = replace(short.signal, dynamic_range_db=70.0, dynamic_range_sigma_db=8.0)
    expected, tracking = (track(sweep, curves) for sweep in (short, replace(short, signal=range_estimate)))
    np.testing.assert_array_equal(tracking.covariance, expected.covariance)


def test_few_grey_levels_are_refused(grey):
    short = grey.part(0, 8)
    assert examine_echoes(matches_of(short)) == ()
    with pytest.raises(MismatchError):
        examine_echoes(matches_of(replace(short, frames=grey.frames[:8] // 32 * 32)))
