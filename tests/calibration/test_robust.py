"""Robust linear equations: wrong ones pull little, groups are weighed as one, what stays open is said."""

from functools import partial

import numpy as np
import pytest

from calibration.robust import cauchy_weights, robust_linear
from speckle3d.core.leastsquares import huber_weights


@pytest.mark.parametrize("weights", [huber_weights, cauchy_weights, partial(huber_weights, limit=0.1)])
def test_wrong_equations_pull_little(weights):
    rng = np.random.default_rng(1)
    matrix, truth = rng.normal(size=(200, 3)), np.array([1.0, -2.0, 3.0])
    wanted = matrix @ truth + rng.normal(0, 0.01, 200)
    wanted[:20] += 50.0
    fit = robust_linear(matrix, wanted, weights, rounds=20)
    assert np.abs(np.linalg.lstsq(matrix, wanted)[0] - truth).max() > 0.5
    np.testing.assert_allclose(fit.parameters, truth, atol=0.005)


def test_a_group_of_equations_is_weighed_as_one():
    matrix = np.tile(np.eye(2), (9, 1, 1))
    wanted = np.tile([1.0, 2.0], (9, 1))
    wanted[0, 0] = 1e6
    fit = robust_linear(matrix, wanted, cauchy_weights, rounds=30)
    np.testing.assert_allclose(fit.parameters, [1.0, 2.0], atol=1e-9)


def test_equations_that_leave_something_open_say_so_by_their_rank():
    matrix = np.column_stack([np.ones(9), 2.0 * np.ones(9)])
    assert robust_linear(matrix, np.ones(9)).rank == 1
