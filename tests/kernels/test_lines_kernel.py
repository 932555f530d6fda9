"""Kernels of line detection against their NumPy twins."""

import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.detection.edges import first_echoes, take_profiles
from calibration.detection.region import Columns
from speckle3d.kernels.lines import agreeing, consensus_line, echo_fronts, echo_levels

SEEDS = st.integers(0, 2**32 - 1)


def picture(seed, n=12, rows=90):
    """Noise, a step in most columns, and a region of up to two runs in each."""
    rng = np.random.default_rng(seed)
    samples = rng.normal(0, 1, (n, rows))
    for line in samples:
        line[rng.integers(5, rows - 5) :] += rng.uniform(0, 30)
    ends = np.sort(rng.integers(0, rows, (n, 4)), axis=1)
    row = np.arange(rows)
    inside = np.array([((row >= a) & (row <= b)) | ((row >= c) & (row <= d)) for a, b, c, d in ends])
    return samples.astype(np.float32), Columns(np.arange(n), inside), rng


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, sigma=st.floats(0.8, 6.0), threshold=st.floats(0.0, 5.0))
def test_edges_are_those_of_separate_convolutions(seed, sigma, threshold):
    samples, columns, _ = picture(seed)
    profiles = take_profiles(samples, columns, sigma)
    found = first_echoes(profiles, profiles.slope, threshold, "slope")
    expected = oracles.edges_of_columns(samples, columns.inside, sigma, threshold)
    # float32 against float64: a maximum right at the threshold, or one as flat as rounding, may differ.
    alike = np.isclose(found.row, expected, atol=1e-2, equal_nan=True)
    assert alike.mean() >= 0.9
    assert (np.isfinite(found.row) == (found.strength > 0)).all()
    assert not profiles.slope[~columns.inside].any()


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, sigma=st.floats(0.8, 6.0))
def test_fronts_and_peaks_are_those_of_interpolation(seed, sigma):
    samples, columns, _ = picture(seed)
    profiles = take_profiles(samples, columns, sigma)
    edges = first_echoes(profiles, profiles.slope, 3.0, "slope").row
    found = np.full(len(edges), -1)
    for s, (place, first, last) in enumerate(columns.spans):
        if first <= edges[place] <= last:
            found[place] = s
    fronts, peaks = np.empty((2, len(edges)))
    echo_fronts(profiles.levels, columns.spans, found, edges, sigma, fronts, peaks)
    expected = oracles.echo_fronts(profiles.levels, columns.inside, edges, sigma)
    np.testing.assert_allclose([fronts, peaks], expected, atol=2e-3)
    both = np.isfinite(fronts)
    assert (fronts[both] <= peaks[both] + 0.5).all()


@settings(deadline=None, max_examples=40)
@given(seed=SEEDS, ahead=st.integers(0, 12))
def test_an_echos_level_is_the_largest_below_its_edge(seed, ahead):
    samples, columns, _ = picture(seed)
    profiles = take_profiles(samples, columns, 2.0)
    out = np.empty_like(samples)
    echo_levels(profiles.slope, profiles.levels, columns.spans, 0.5, 1.0, ahead, out)
    for place, first, last in columns.spans:
        for j in range(first, last + 1):
            slope = profiles.slope[place]
            peak = first < j < last and slope[j] > 0.5 and slope[j - 1] < slope[j] >= slope[j + 1]
            brightest = profiles.levels[place, j : min(j + ahead, last) + 1].max()
            assert out[place, j] == (max(brightest - np.float32(1.0), 0.0) if peak else 0.0)


@settings(deadline=None, max_examples=60)
@given(seed=SEEDS, n=st.integers(0, 20), tolerance=st.floats(0.5, 8.0), missing=st.floats(0.0, 0.5))
def test_the_line_is_the_one_of_all_pairs(seed, n, tolerance, missing):
    _, columns, rng = picture(seed, n) if n else (None, Columns(np.arange(0), np.ones((0, 90), bool)), None)
    column = 7.0 * columns.column
    row = np.empty(n)
    if n:
        row = rng.uniform(20, 60) + rng.uniform(-0.3, 0.3) * column + rng.normal(0, tolerance / 2, n)
        row[rng.random(n) < missing] = rng.uniform(0, 90)
        row[rng.random(n) < missing / 2] = np.nan
    agree = np.empty(n, bool)
    possible, start, slope = consensus_line(column, row, columns.inside, tolerance, agree)
    expected, could, *line = oracles.consensus_line(column, row, columns.inside, tolerance)
    assert agree.sum() == expected.sum()
    # Lines that no third point agrees with are all the same but for rounding.
    if agree.sum() > 2:
        np.testing.assert_array_equal(agree, expected)
        assert possible == could
        np.testing.assert_allclose([start, slope], line, rtol=1e-7, atol=1e-7)


def test_a_point_agrees_up_to_the_tolerance_and_only_where_the_region_holds_the_line():
    inside = np.ones((5, 30), bool)
    inside[3, 10:] = False
    column, row = np.arange(5.0), np.array([12.0, 12.01, 8.0, 10.0, np.nan])
    agree = np.empty(5, bool)
    assert agreeing(column, row, inside, 10.0, 0.0, 2.0, agree) == (2, 4, 8.0)
    assert agree.tolist() == [True, False, True, False, False]
    # Below row 29.5 in the last two columns alone, of which one is not in the region.
    assert agreeing(column, row, inside, 31.0, -0.6, 2.0, agree)[1] == 1
