from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.leastsquares import (
    cauchy_weights,
    huber_weights,
    levenberg_marquardt,
    robust_linear,
    robust_sigma,
)

# NIST StRD Misra1a, y = b1 (1 - exp(-b2 x)): certified values and standard deviations,
# https://www.itl.nist.gov/div898/strd/nls/data/misra1a.shtml
MISRA1A = """
10.07  77.6   14.73 114.9   17.94 141.1   23.93 190.8   29.61 239.9   35.18 289.0   40.02 332.8
44.82 378.4   50.76 434.8   55.05 477.3   61.01 536.8   66.40 593.1   75.47 689.1   81.78 760.0
"""
MISRA1A_Y, MISRA1A_X = np.array(MISRA1A.split(), dtype=float).reshape(-1, 2).T
CERTIFIED = np.array([2.3894212918e02, 5.5015643181e-04])
CERTIFIED_SD = np.array([2.7070075241e00, 7.2668688436e-06])
CERTIFIED_SUM_OF_SQUARES = 1.2455138894e-01


def misra1a(b):
    return b[0] * (1.0 - np.exp(-b[1] * MISRA1A_X)) - MISRA1A_Y


def misra1a_jacobian(b):
    decay = np.exp(-b[1] * MISRA1A_X)
    return np.stack([1.0 - decay, b[0] * MISRA1A_X * decay], axis=1)


@pytest.mark.parametrize("start", [(500.0, 1e-4), (250.0, 5e-4)])
@pytest.mark.parametrize(
    # Forward differences err by the square root of rounding, 1e-8, times the conditioning of this problem.
    ("jacobian", "rtol"),
    [(None, 1e-4), (misra1a_jacobian, 1e-8)],
    ids=["differences", "analytic"],
)
def test_misra1a_from_both_certified_starts(start, jacobian, rtol):
    fit = levenberg_marquardt(misra1a, np.array(start), jacobian, names=("b1", "b2"))
    assert fit.converged
    np.testing.assert_allclose(fit.parameters, CERTIFIED, rtol=1e-7)
    np.testing.assert_allclose(fit.standard_errors, CERTIFIED_SD, rtol=rtol)
    assert fit.residuals @ fit.residuals == pytest.approx(CERTIFIED_SUM_OF_SQUARES, rel=1e-7)
    assert fit.rms == pytest.approx(np.sqrt(CERTIFIED_SUM_OF_SQUARES / 14), rel=1e-7)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(1e-4, 1e4))
def test_linear_problem_has_the_textbook_covariance_whatever_the_units(seed, scale):
    rng = np.random.default_rng(seed)
    design, y = rng.normal(size=(30, 3)) * [1.0, scale, 1.0 / scale], rng.normal(size=30)
    fit = levenberg_marquardt(lambda b: design @ b - y, np.zeros(3), lambda _: design)
    exact = np.linalg.lstsq(design, y)[0]
    sd = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * np.sum((design @ exact - y) ** 2) / 27)
    np.testing.assert_allclose(fit.parameters, exact, atol=1e-6 * sd.max(), rtol=1e-6)
    np.testing.assert_allclose(fit.standard_errors, sd, rtol=1e-6)


def test_only_a_sum_is_determined_so_both_terms_have_infinite_variance():
    x = np.linspace(0.0, 1.0, 20)
    noise = np.random.default_rng(1).normal(0.0, 0.1, 20)

    def residuals(b):
        return (b[0] + b[1]) * x + b[2] - 2.0 * x - 1.0 - noise

    def jacobian(_):
        return np.stack([x, x, np.ones_like(x)], axis=1)

    fit = levenberg_marquardt(residuals, np.zeros(3), jacobian, names=("left", "right", "height"))
    assert np.isinf(fit.standard_errors[:2]).all()
    assert 0 < fit.standard_errors[2] < 0.1
    assert fit.condition_number > 1e12
    assert fit.parameters[:2].sum() == pytest.approx(2.0, abs=0.3)


def test_a_parameter_without_influence_is_singular():
    x = np.linspace(0.0, 1.0, 5)
    fit = levenberg_marquardt(
        lambda b: b[0] * x - x,
        np.zeros(2),
        lambda _: np.stack([x, 0 * x], axis=1),
        names=("slope", "idle"),
    )
    assert fit.condition_number == np.inf
    assert np.isinf(fit.standard_errors[1])
    assert np.isfinite(fit.standard_errors[0])


def test_column_scaling_makes_the_condition_number_free_of_units():
    x = np.linspace(0.0, 1.0, 30)
    numbers = [
        levenberg_marquardt(lambda b, k=k: b[0] + k * b[1] * x - x**2, np.zeros(2)).condition_number
        for k in (1.0, 1e6)
    ]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-4)


def test_too_few_residuals_are_counted_in_the_error():
    with pytest.raises(InvalidInputError, match=r"3 residuals.*2"):
        levenberg_marquardt(lambda b: b[:2], np.zeros(3))


def test_residuals_that_are_not_finite_are_refused():
    with pytest.raises(InvalidInputError, match="finite"):
        levenberg_marquardt(lambda b: np.full(4, np.nan) * b[0], np.ones(1))


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
    assert fit.weights.shape == (9,)
    assert fit.weights[0] < 1e-6


def test_exact_equations_are_all_kept():
    matrix = np.random.default_rng(3).normal(size=(30, 4))
    fit = robust_linear(matrix, matrix @ np.arange(4.0))
    np.testing.assert_allclose(fit.parameters, np.arange(4.0), atol=1e-12)
    np.testing.assert_array_equal(fit.weights, 1.0)


def test_equations_that_leave_something_open_say_so_by_their_rank():
    matrix = np.column_stack([np.ones(9), 2.0 * np.ones(9)])
    assert robust_linear(matrix, np.ones(9)).rank == 1


def test_robust_sigma_is_that_of_normal_residuals():
    assert robust_sigma(np.random.default_rng(4).normal(0, 3.0, 100_000)) == pytest.approx(3.0, rel=0.01)
    assert robust_sigma(np.zeros(5), smallest=1e-7) == 1e-7
