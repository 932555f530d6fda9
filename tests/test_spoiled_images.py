"""Sweeps whose images are not one moving probe's, through the whole pipeline: never confident and wrong."""

from dataclasses import replace

import numpy as np
import pytest
import spoiled_images as spoil
from accuracy_set import SHEET
from sweep_examples import frames_of

from speckle3d.config import Config
from speckle3d.core.errors import InsufficientDataError
from speckle3d.sheet_curves import data_sheet_curves
from speckle3d.simulation.receiver import received
from speckle3d.tracking import track


@pytest.fixture(scope="module")
def narrow(sweep):
    """Two columns of patches of the shipped sweep."""
    return spoil.first_vectors(sweep)


@pytest.fixture(scope="module")
def pattern(narrow):
    """Speckle of another place: a frame of the sweep the other way round."""
    return narrow.frames[40][::-1].copy()


def length_of(sweep, tracking):
    """Farthest distance travelled by truth and as found, and the standard error claimed there, mm."""
    centre = sweep.grid.centre_mm
    true = (sweep.truth[0].inv() * sweep.truth).apply(centre)[:, 2]
    at = int(np.argmax(np.abs(true)))
    estimate = tracking.image.apply(centre)[:, 2]
    return abs(true[at]), abs(estimate[at]), float(np.sqrt(tracking.covariance[at, 2, 2]))


def test_static_clutter_as_strong_as_the_signal_is_refused(narrow, curves, pattern):
    with pytest.raises(InsufficientDataError, match="static clutter"):
        track(spoil.clutter(narrow, pattern), curves)


def test_noise_on_a_probe_at_rest_is_no_sweep(narrow, curves):
    with pytest.raises(InsufficientDataError):
        track(spoil.at_rest(spoil.in_order(narrow, range(40))), curves)


def test_a_shadow_is_left_out_and_told_and_the_length_stays(sweep, curves):
    spoilt = spoil.shadow(sweep.part(0, 48), slice(12, 36), slice(1200, None))
    tracking = track(spoilt, curves)
    true, estimate, sigma = length_of(spoilt, tracking)
    assert abs(estimate / true - 1) < 0.03
    assert abs(estimate - true) < 2 * sigma
    assert any("which is left out" in str(doubt) for doubt in tracking.doubts)


@pytest.mark.parametrize("signal", ["rf", "bmode"])
def test_what_stands_still_is_left_out_and_the_length_stays(sweep, curves, signal):
    """Ringing in a gap of gel over a third of the image; text on images of grey."""
    part = sweep.part(0, 48)
    if signal == "rf":
        spoilt, probe_curves = spoil.ringing(part, slice(0, 16)), curves
    else:
        part = received(part, dynamic_range_db=60.0)
        # The lens of a data sheet is not fitted: by fewer patches it is another one.
        spoilt, probe_curves = spoil.text_overlay(part), replace(data_sheet_curves(SHEET, part), origin="")
    clean, spoilt = (length_of(s, track(s, probe_curves)) for s in (part, spoilt))
    assert spoilt[1] == pytest.approx(clean[1], rel=0.015)


def test_what_stands_still_outside_the_region_changes_nothing(sweep, curves):
    part = sweep.part(0, 40)
    frames = frames_of(part).astype(np.float32)
    frames[:, 24:] = frames[0, 24:]
    settings = Config(patches={"region": "rectangle 0,0 7,40"})
    true, estimate, sigma = length_of(part, track(spoil.with_frames(part, frames), curves, settings))
    assert abs(estimate / true - 1) < 0.03
    assert abs(estimate - true) < 2 * sigma


@pytest.mark.slow
def test_a_gap_is_told_and_counts_in_the_error(narrow, curves):
    sweep = spoil.in_order(narrow, [*range(40), *range(56, 96)])
    tracking = track(sweep, curves)
    true, estimate, sigma = length_of(sweep, tracking)
    assert ["frames lost" in doubt.suspect for doubt in tracking.doubts] == [True]
    assert sigma > 0.8
    assert abs(estimate - true) < 4 * sigma
