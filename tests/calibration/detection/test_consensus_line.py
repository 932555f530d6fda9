"""The line that most points agree on."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.detection.lines import consensus_line


@settings(deadline=None, max_examples=40, derandomize=True)  # how many agree is a matter of chance
@given(seed=st.integers(0, 2**32 - 1), tolerance=st.floats(0.5, 4.0), share=st.floats(0.3, 1.0))
def test_most_points_agree_wherever_the_others_lie(seed, tolerance, share):
    rng, column = np.random.default_rng(seed), 7.0 * np.arange(40)
    true = rng.uniform(60, 90) + rng.uniform(-0.1, 0.1) * column
    row = true + rng.uniform(-0.9, 0.9, 40) * tolerance
    wrong = rng.random(40) > share
    row[wrong] = rng.choice([np.nan, 5.0, 145.0], wrong.sum())
    agree, possible, start, slope = consensus_line(column, row, np.ones((40, 150), bool), tolerance)
    if (~wrong).sum() > 0.55 * 40:
        assert agree.sum() >= (~wrong).sum() - 3
        assert possible == 40
        assert np.abs(start + slope * column - true).max() < 2 * tolerance
