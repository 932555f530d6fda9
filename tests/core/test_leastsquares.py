import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.leastsquares import levenberg_marquardt

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


def test_only_a_sum_is_determined_so_both_terms_have_infinite_variance_and_are_named():
    x = np.linspace(0.0, 1.0, 20)
    noise = np.random.default_rng(1).normal(0.0, 0.1, 20)

    def residuals(b):
        return (b[0] + b[1]) * x + b[2] - 2.0 * x - 1.0 - noise

    def jacobian(_):
        return np.stack([x, x, np.ones_like(x)], axis=1)

    fit = levenberg_marquardt(residuals, np.zeros(3), jacobian, names=("left", "right", "height"))
    assert np.isinf(fit.standard_errors[:2]).all()
    assert 0 < fit.standard_errors[2] < 0.1
    assert set(fit.weakest_parameters()) == {"left", "right"}
    assert fit.condition_number > 1e12
    assert fit.parameters[:2].sum() == pytest.approx(2.0, abs=0.3)


def test_a_parameter_without_influence_is_singular_and_named():
    x = np.linspace(0.0, 1.0, 5)
    fit = levenberg_marquardt(
        lambda b: b[0] * x - x,
        np.zeros(2),
        lambda _: np.stack([x, 0 * x], axis=1),
        names=("slope", "idle"),
    )
    assert fit.weakest_parameters() == ("idle",)
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
    with pytest.raises(InvalidInputError, match="at least 3 residuals, got 2"):
        levenberg_marquardt(lambda b: b[:2], np.zeros(3))


def test_residuals_that_are_not_finite_are_refused():
    with pytest.raises(InvalidInputError, match="finite residuals at the starting point"):
        levenberg_marquardt(lambda b: np.full(4, np.nan) * b[0], np.ones(1))


def test_running_out_of_evaluations_is_not_called_converged():
    fit = levenberg_marquardt(misra1a, np.array([500.0, 1e-4]), misra1a_jacobian, max_evaluations=2)
    assert not fit.converged
