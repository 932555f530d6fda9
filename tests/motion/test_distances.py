import numpy as np
import pytest
import speckle
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.motion.distances import DistanceEstimator
from speckle3d.motion.patches import lay_patches

PATCHES = lay_patches(speckle.GRID)
SIGMA_MM, CELLS = 0.45, 25.0
WIDTHS_MM = (0.3, 0.6)
DEPTHS_MM = (5.0, 25.0)


@pytest.fixture(scope="module")
def estimator():
    return DistanceEstimator(speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS), PATCHES)


@settings(deadline=None, max_examples=60)
@given(
    d=st.floats(0.01, 1.4),
    law=st.sampled_from([speckle.gaussian_correlation, speckle.triangle_correlation]),
)
def test_distance_is_the_inverse_of_the_curve(d, law):
    curves = speckle.curves(law, sigma_mm=0.6)
    got = DistanceEstimator(curves, PATCHES).distances(np.full(len(PATCHES), law(d, 0.6)))
    if law(d, 0.6) > 0.05:
        np.testing.assert_allclose(got.distance_mm, d, atol=1e-3)


def test_each_patch_is_read_on_the_curve_of_its_own_depth():
    curves = speckle.curves(sigma_mm=WIDTHS_MM, depth_mm=DEPTHS_MM)
    got = DistanceEstimator(curves, PATCHES).distances(np.full(len(PATCHES), 0.5)).distance_mm
    # 1 / sigma is linear in depth where sqrt(-ln rho) is.
    width = 1 / np.interp(PATCHES.centre_mm[:, 1], DEPTHS_MM, 1 / np.array(WIDTHS_MM))
    np.testing.assert_allclose(got, width * np.sqrt(2 * np.log(2)), atol=1e-3)


def test_no_correlation_is_no_distance(estimator):
    rho = np.full(len(PATCHES), 0.5)
    rho[:4] = [np.nan, -0.3, 0.0, 0.01]
    got = estimator.distances(rho)
    assert np.isnan(got.distance_mm[:4]).all()
    assert np.isnan(got.sigma_mm[:4]).all()
    assert np.isfinite(got.distance_mm[4:]).all()
    assert (got.sigma_mm[4:] > 0).all()


@pytest.mark.parametrize("rho", [1.0, 1.3, 0.99999])
def test_coefficients_of_one_and_over_are_next_to_no_distance(estimator, rho):
    got = estimator.distances(np.full(len(PATCHES), rho))
    # sqrt(-2 ln 0.9999) deviations of the beam.
    assert (got.distance_mm <= 0.0142 * SIGMA_MM + 1e-3).all()
    assert (got.distance_mm >= 0).all()
    assert (got.sigma_mm > 0).all()


def test_distance_falls_with_correlation(estimator):
    rho = np.linspace(0.04, 1.0, 200)
    d = np.array([estimator.distances(np.full(len(PATCHES), r)).distance_mm[0] for r in rho])
    assert (np.diff(d) <= 0).all()
    assert d[-1] < d[0]


@pytest.mark.parametrize(
    # u = d / sigma_e; deviation (sigma_e / sqrt N) 2 sinh(u^2 / 2) / u from Var rho = (1 - rho^2)^2 / N.
    ("u", "predicted_mm"),
    [(1 / 3, 0.030), (2 / 3, 0.060), (1.0, 0.094)],
)
def test_predicted_deviation(estimator, u, predicted_mm):
    formula = SIGMA_MM / np.sqrt(CELLS) * 2 * np.sinh(u**2 / 2) / u
    assert abs(formula - predicted_mm) < 1e-3
    got = estimator.sigma(np.full(len(PATCHES), u * SIGMA_MM))
    # The curve's slope comes from a table of 0.01 mm.
    np.testing.assert_allclose(got, formula, rtol=0.02)


@pytest.mark.parametrize("u", [1 / 3, 2 / 3, 1.0])
def test_predicted_deviation_is_that_of_sampled_coefficients(estimator, u):
    """Pearson's coefficient of 25 pairs of normal numbers, drawn 20 000 times, read as distance."""
    rng = np.random.default_rng(8)
    rho = np.exp(-(u**2) / 2)
    a, b = rng.normal(size=(2, 20000, int(CELLS)))
    b = rho * a + np.sqrt(1 - rho**2) * b
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (a, b))
    r = (a * b).sum(axis=1) / np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    r = r[: r.size // len(PATCHES) * len(PATCHES)].reshape(-1, len(PATCHES))
    d = np.array([estimator.distances(row).distance_mm for row in r])
    predicted = estimator.sigma(np.full(len(PATCHES), u * SIGMA_MM))[0]
    # The prediction is of first order; the curve bends over a deviation, which adds 14 % at u = 1.
    assert abs(np.nanstd(d) / predicted - 1) < 0.16


def test_relative_deviation_is_the_same_for_all_small_distances(estimator):
    small = [estimator.sigma(np.full(len(PATCHES), d))[0] / d for d in (0.03, 0.06, 0.12)]
    np.testing.assert_allclose(small, 1 / np.sqrt(CELLS), rtol=0.05)


def test_more_cells_mean_less_deviation(estimator):
    finer = DistanceEstimator(speckle.curves(sigma_mm=SIGMA_MM, cells=4 * CELLS), PATCHES)
    d = np.full(len(PATCHES), 0.3)
    np.testing.assert_allclose(finer.sigma(d), estimator.sigma(d) / 2, rtol=1e-6)


def test_beside_a_noise_floor_the_deviation_near_zero_is_that_of_the_squared_distance():
    """Where noise takes a tenth of the coefficient, short distances are not known better than longer ones."""
    made = speckle.curves(
        lambda d, s: 0.9 * speckle.gaussian_correlation(d, s), sigma_mm=SIGMA_MM, cells=CELLS
    )
    estimator = DistanceEstimator(made, PATCHES)
    near = [estimator.sigma(np.full(len(PATCHES), d))[0] for d in (0.0, 0.01, 0.03)]
    # d^2 = -2 sigma_e^2 ln(rho / 0.9) has the deviation 2 sigma_e^2 (1 - rho^2) / (rho sqrt N).
    expected = np.sqrt(2 * SIGMA_MM**2 * (1 - 0.81) / (0.9 * np.sqrt(CELLS)))
    np.testing.assert_allclose(near, expected, rtol=0.45)
