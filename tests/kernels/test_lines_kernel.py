"""The line that most points agree on, against its NumPy twin."""

import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.kernels.lines import agreeing, consensus_line


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 20),
    tolerance=st.floats(0.5, 8.0),
    missing=st.floats(0.0, 0.5),
)
def test_the_line_is_the_one_of_all_pairs(seed, n, tolerance, missing):
    rng, column = np.random.default_rng(seed), 7.0 * np.arange(n)
    low, high = np.sort(rng.integers(0, 90, (2, n)), axis=0)
    inside = (np.arange(90) >= low[:, None]) & (np.arange(90) <= high[:, None])
    row = rng.uniform(20, 60) + rng.uniform(-0.3, 0.3) * column + rng.normal(0, tolerance / 2, n)
    row[rng.random(n) < missing] = rng.uniform(0, 90)
    row[rng.random(n) < missing / 2] = np.nan
    agree = np.empty(n, bool)
    possible, start, slope = consensus_line(column, row, inside, tolerance, agree)
    expected, could, *line = oracles.consensus_line(column, row, inside, tolerance)
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
