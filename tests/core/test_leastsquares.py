import numpy as np
import pytest

from speckle3d.core.leastsquares import condition_number, robust_sigma


def test_robust_sigma_is_that_of_normal_residuals():
    assert robust_sigma(np.random.default_rng(4).normal(0, 3.0, 100_000)) == pytest.approx(3.0, rel=0.01)
    assert robust_sigma(np.zeros(5), smallest=1e-7) == 1e-7


def test_the_condition_number_is_free_of_units_and_infinite_without_influence():
    x = np.linspace(0.0, 1.0, 30)
    numbers = [condition_number(np.column_stack([np.ones(30), k * x])) for k in (1.0, 1e6)]
    assert numbers[0] == pytest.approx(numbers[1])
    cosine = x.sum() / np.sqrt(30 * x @ x)
    assert numbers[0] == pytest.approx(np.sqrt((1 + cosine) / (1 - cosine)))
    assert condition_number(np.column_stack([x, 0 * x])) == np.inf
