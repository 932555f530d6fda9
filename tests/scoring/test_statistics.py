import numpy as np
import pytest

from speckle3d.scoring.statistics import holm, mean_interval, signed_rank_p


def test_the_interval_of_many_values_is_the_textbook_one():
    values = np.random.default_rng(5).normal(2.0, 0.5, size=400)
    interval = mean_interval(values)
    half = 1.96 * values.std() / np.sqrt(400)
    # A percentile from 9999 resamples scatters by about 0.03 standard errors: 4 of these of 1.96.
    assert interval["low"] == pytest.approx(values.mean() - half, abs=0.06 * half)
    assert interval["high"] == pytest.approx(values.mean() + half, abs=0.06 * half)
    assert interval == mean_interval(values)


def test_holms_correction_by_hand():
    assert holm([0.01, None, 0.04, 0.03]) == pytest.approx([0.03, None, 0.06, 0.06])
    assert holm([0.6, 0.9]) == [1.0, 1.0]


def test_few_or_equal_values_have_no_interval_and_no_test():
    for values in ([1.0], [1.0, 3.0], [2.0, 2.0, 2.0, 2.0]):
        assert signed_rank_p(values) is None
        mean = np.mean(values)
        assert mean_interval(values) == {"sweeps": len(values), "mean": mean, "low": None, "high": None}


def test_the_signs_of_five_sweeps_alike_are_two_of_their_assignments():
    # Of the 2**5; scatter between sweeps is in none of the differences.
    assert signed_rank_p([1.0, 1.1, 0.9, 1.2, 0.8]) == pytest.approx(2 / 2**5)
