import numpy as np
import pytest

from speckle3d.core.errors import InsufficientDataError
from speckle3d.scoring.statistics import holm, mean_interval, paired_comparison


def test_the_interval_of_many_values_is_the_textbook_one():
    values = np.random.default_rng(5).normal(2.0, 0.5, size=400)
    found = mean_interval(values)
    half = 1.96 * values.std() / np.sqrt(400)
    # A percentile from 9999 resamples scatters by about 0.03 standard errors: 4 of these of 1.96.
    assert found.low == pytest.approx(values.mean() - half, abs=0.06 * half)
    assert found.high == pytest.approx(values.mean() + half, abs=0.06 * half)
    assert found == mean_interval(values)


def test_holms_correction_by_hand():
    assert holm([0.01, None, 0.04, 0.03]) == [
        pytest.approx(0.03),
        None,
        pytest.approx(0.06),
        pytest.approx(0.06),
    ]
    assert holm([0.6, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_few_or_equal_values_have_no_interval():
    for values in ([1.0], [1.0, 3.0], [2.0, np.nan, 4.0], [2.0, 2.0, 2.0, 2.0]):
        found = mean_interval(values)
        assert (found.low, found.high) == (None, None)
        assert found.mean == np.nanmean(values)
    assert mean_interval([2.0, np.nan, 4.0]).sweeps == 2
    with pytest.raises(InsufficientDataError):
        mean_interval([np.nan])


def test_a_pair_sees_what_scatter_between_sweeps_hides():
    sweeps = np.array([1.0, 5.0, 9.0, 14.0, 20.0])
    difference, wilcoxon_p = paired_comparison(sweeps + np.array([1.0, 1.1, 0.9, 1.2, 0.8]), sweeps)
    assert difference.mean == pytest.approx(1.0)
    assert 0.8 < difference.low < 1.0 < difference.high < 1.2
    # All five signs alike: 2 of the 2**5 assignments are as extreme.
    assert wilcoxon_p == pytest.approx(2 / 2**5)
