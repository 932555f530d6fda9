"""What depths that disagree, and lengths that are known, say of curves."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.motion.corrected_curves import corrected_curves
from speckle3d.motion.curve_prior import CurveCorrection, RowsSeen, learn_correction, straightened
from speckle3d.motion.data_sheet import ProbeSheet
from speckle3d.motion.diffraction import half_distance
from speckle3d.sheet_curves import data_sheet_curves

ROWS = np.linspace(4.0, 31.0, 10)
SAMPLED = {"sampling_rate_mhz": 66.7, "vector_pitch_mm": 0.3, "elevation_aperture_mm": 5.0, "depth_mm": 36.0}


def sheet(focus_mm):
    return data_sheet_curves(ProbeSheet(band_mhz=(5.0, 10.0), elevation_focus_mm=focus_mm, **SAMPLED))


@pytest.fixture(scope="module")
def given():
    return sheet(23.0)


@pytest.fixture(scope="module")
def true():
    return sheet(20.0)


def widths(curves, depth_mm=ROWS):
    return np.array([half_distance(curves.distance_mm, row) for row in curves.at(depth_mm).correlation])


@dataclass
class Reading:
    curves: DecorrelationCurves
    rows: RowsSeen


def seen(used, true, noise=0.01, seed=1):
    """Rows of a sweep that was read with `used`, the path lying in their middle, and its true log scale."""
    wanted = -np.log(widths(true) / widths(used))
    mean = wanted.mean()
    off = noise * np.random.default_rng(seed).standard_normal(ROWS.size)
    return RowsSeen(ROWS, wanted - mean + off, np.full(ROWS.size, 0.02)), -mean


@pytest.mark.slow
def test_a_bend_tells_of_the_common_factor_too(given, true):
    rows, log_scale = seen(given, true)
    better, sigma = straightened(given, rows, given.scale_sigma)
    before, after = (np.log(widths(true) / widths(c)).mean() for c in (given, better))
    assert before == pytest.approx(log_scale)
    # A focus 15 % off: 9 % of length, more than half of which the bend takes out.
    assert abs(before) > 0.06
    assert abs(after) < 0.5 * abs(before)
    assert abs(after) < 2 * sigma < 2 * given.scale_sigma
    assert np.ptp(np.log(widths(true) / widths(better))) < 0.5 * np.ptp(np.log(widths(true) / widths(given)))


def test_measured_curves_stay_as_they_are_where_depths_agree(curves):
    rows = RowsSeen(ROWS, 0.012 * np.random.default_rng(2).standard_normal(ROWS.size), np.full(10, 0.02))
    kept, sigma = straightened(curves, rows, 0.08)
    assert kept is curves
    assert sigma == 0.08


@pytest.mark.slow
def test_known_lengths_decide_the_common_factor(given, true):
    readings, scales = zip(*(seen(given, true, seed=s) for s in (3, 4)), strict=True)
    tracked = [Reading(given, rows) for rows in readings]
    found = corrected_curves(given, tracked, scales, [0.01, 0.01])
    left = np.log(widths(true) / widths(found))
    assert abs(left.mean()) < 0.01
    assert np.abs(left).max() < 0.04
    assert found.origin == "crossing"
    assert 0.027 < found.scale_sigma < 0.035


@pytest.mark.slow
def test_a_factor_that_no_lens_makes_is_taken_over(given):
    flat = Reading(given, RowsSeen(ROWS, np.zeros(10), np.full(10, 0.02)))
    found = corrected_curves(given, [flat], [0.10], [0.01])
    assert np.log(widths(found) / widths(given)).mean() == pytest.approx(0.10, abs=0.004)


@pytest.mark.slow
def test_sweeps_read_with_straightened_curves_correct_those_given(given, true):
    rows, log_scale = seen(given, true, noise=0.0)
    better, _ = straightened(given, rows, given.scale_sigma)
    again, left = seen(better, true, noise=0.0)
    found = corrected_curves(given, [Reading(better, again)], [left], [0.01])
    assert np.log(widths(found) / widths(given)).mean() == pytest.approx(log_scale, abs=0.01)


def test_factors_stretch_each_depth_by_its_own(given):
    logarithm = np.linspace(-0.2, 0.1, given.depth_mm.size)
    found = CurveCorrection(given.depth_mm, logarithm, 0.0, 0.0).applied(given)
    ratio = np.log(widths(found, given.depth_mm) / widths(given, given.depth_mm))
    np.testing.assert_allclose(ratio, logarithm, atol=0.01)


@pytest.mark.slow
def test_odds_are_for_another_lens_only_where_there_is_one(given, true):
    bent, flat = seen(given, true)[0], seen(given, given)[0]
    phantom = replace(given, origin="phantom")
    assert learn_correction(phantom, [bent]).log_odds > 2.0
    assert learn_correction(phantom, [flat]).log_odds < 0.0


@pytest.mark.parametrize(("scale", "sigma"), [([], []), ([0.1, 0.2], [0.01, 0.01]), ([0.1], [0.0])])
def test_lengths_that_are_missing_are_told(given, scale, sigma):
    with pytest.raises(InsufficientDataError, match="corrected curves: expected"):
        corrected_curves(given, [Reading(given, RowsSeen(ROWS, 0 * ROWS, 1 + 0 * ROWS))], scale, sigma)
