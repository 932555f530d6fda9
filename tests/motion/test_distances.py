from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import speckle
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.matching.inplane import InPlaneMotion, match_with_each
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.distances import (
    INTERPOLATION,
    SHARE_ERROR,
    DistanceEstimator,
    EchoModel,
)

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
    d = estimator.distances(r).distance_mm
    predicted = estimator.sigma(np.full(len(PATCHES), u * SIGMA_MM))[0]
    # The prediction is of first order; the curve bends over a deviation, which adds 14 % at u = 1.
    assert abs(np.nanstd(d) / predicted - 1) < 0.16


def test_relative_deviation_is_the_same_for_all_small_distances_but_for_interpolation(estimator):
    """1 / sqrt N, beside which an error that no number of cells removes grows towards no distance."""
    for d in (0.06, 0.12, 0.2):
        rest = INTERPOLATION * SIGMA_MM**2 / d**2
        got = estimator.sigma(np.full(len(PATCHES), d))[0] / d
        assert got == pytest.approx(np.hypot(1 / np.sqrt(CELLS), rest), rel=0.06)
    assert INTERPOLATION < 0.005


def test_more_cells_mean_less_deviation(estimator):
    finer = DistanceEstimator(speckle.curves(sigma_mm=SIGMA_MM, cells=4 * CELLS), PATCHES)
    d = np.full(len(PATCHES), 0.3)
    # All but what interpolation leaves.
    np.testing.assert_allclose(finer.sigma(d), estimator.sigma(d) / 2, rtol=0.01)


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


# ---- echoes ----------------------------------------------------------------------------------------------


def of_echo(made):
    return replace(made, key=replace(made.key, correlation_of="echo"))


def cramer_rao_mm(d, cells, sigma_mm=SIGMA_MM):
    """Least deviation of a distance: complex Gaussian echoes, their power unknown, r = exp(-d^2 / 4 s^2)."""
    r = np.exp(-(d**2) / (4 * sigma_mm**2))
    return (1 - r**2) / (np.sqrt(2 * cells) * r * d / (2 * sigma_mm**2))


@pytest.mark.parametrize("u", [1 / 3, 2 / 3, 1.0, 1.5])
def test_predicted_deviation_of_the_echos_distances_is_the_cramer_rao_bound(u):
    cells = 45.0
    estimator = DistanceEstimator(of_echo(speckle.curves(sigma_mm=SIGMA_MM, cells=cells)), PATCHES)
    assert estimator.of_echo
    got = estimator.sigma(np.full(len(PATCHES), u * SIGMA_MM))
    ratio = got / cramer_rao_mm(u * SIGMA_MM, cells)
    # Above it by a term of second order in 1 / N, 1 / (4 N rho), 2 % at the last, and at the first by what
    # interpolation leaves, 4 %; the curve's slope comes from a table of 0.01 mm.
    assert (ratio > 0.98).all()
    assert (ratio < 1.06).all()


@cache
def fields():
    return [speckle.Speckle(np.random.default_rng(seed)).seen() for seed in range(13)]


@cache
def read(u, kind):
    """Distances of the patches of a dozen pairs, `u` beam deviations apart, read with curves of their own."""
    rho, found = float(np.exp(-(u**2) / 2)), []
    estimator = DistanceEstimator(speckle.curves(sigma_mm=SIGMA_MM), PATCHES)
    for one, other in zip(fields()[:-1], fields()[1:], strict=True):
        both = one, speckle.decorrelated(one, other, rho)
        echoes = (
            tuple(np.stack([z.real, z.imag]).astype(np.float32) for z in both) if kind == "echo" else None
        )
        images = [speckle.intensity(z) for z in both]
        match = match_with_each(
            images[:1],
            images[1],
            PATCHES,
            [InPlaneMotion()],
            speckle.GRID.centre_mm,
            echoes=echoes and ([echoes[0]], echoes[1]),
            wavenumber_per_mm=57.0,
        )[0]
        found.append(estimator.distances(match.correlation).distance_mm)
    return np.array(found)


def cells_of_a_patch():
    """Its area over the integral of the squared autocorrelation of the echo, both axes, within the patch."""
    lags = (np.arange(1 - n, n) for n in PATCHES.size)
    sums = [
        (speckle.gaussian_correlation(lag * step, sigma) * (1 - np.abs(lag) / n)).sum()
        for lag, n, step, sigma in zip(
            lags, PATCHES.size, PATCHES.spacing_mm, (speckle.LATERAL_MM, speckle.AXIAL_MM), strict=True
        )
    ]
    return PATCHES.size.prod() / np.prod(sums)


@pytest.mark.parametrize("u", [1 / 3, 2 / 3, 1.0])
def test_the_echos_distances_reach_the_bound_and_intensitys_do_not(u):
    """In-plane motion searched as in a sweep; 670 distances, whose deviation is known to 3 %."""
    bound = cramer_rao_mm(u * SIGMA_MM, cells_of_a_patch())
    echo, intensity = (np.nanstd(read(u, kind)) / bound for kind in ("echo", "intensity"))
    assert echo == pytest.approx(1.0, abs=0.1)
    assert intensity > 1.3


@pytest.mark.parametrize("u", [1 / 3, 2 / 3, 1.0])
def test_the_echos_distances_are_unbiased(u):
    # (1 - rho)^2 / N too much correlation and the search's share make less than a hundredth of a beam.
    assert np.nanmean(read(u, "echo")) == pytest.approx(u * SIGMA_MM, abs=0.012 * SIGMA_MM)


# ---- echo models -----------------------------------------------------------------------------------------


def model(share=0.0, gain=1.0):
    return EchoModel(*(np.full((1, len(PATCHES)), value) for value in (share, gain)))


@settings(deadline=None, max_examples=60)
@given(d=st.floats(0.02, 1.0), c=st.floats(0.0, 0.7), gain=st.floats(0.4, 1.0))
def test_distance_is_the_inverse_of_the_echo_model(estimator, d, c, gain):
    moving = np.exp(-(d**2) / (4 * SIGMA_MM**2))
    rho = gain * (c + (1 - c) * moving) ** 2
    if moving > 0.25:
        got = estimator.distances(np.full(len(PATCHES), rho), model(c, gain))
        # The table's thousandth; above 0.9999 of correlation there are no distances to tell.
        np.testing.assert_allclose(got.distance_mm, d, atol=2e-3)


@pytest.mark.parametrize("rho", [0.95, 0.6, 0.2])
def test_a_phantoms_model_changes_nothing(estimator, rho):
    correlation = np.full((1, len(PATCHES)), rho)
    plain = estimator.distances(correlation)
    read_with = estimator.distances(correlation, EchoModel.fully_developed(len(PATCHES)))
    np.testing.assert_allclose(read_with.distance_mm, plain.distance_mm, rtol=1e-12)
    np.testing.assert_allclose(read_with.sigma_mm, plain.sigma_mm, rtol=1e-12)


def test_what_stays_is_no_sign_of_a_short_distance(estimator):
    """Below what stays there is no distance; just above, a long and uncertain one."""
    made = model(0.5)
    low, just, well = (estimator.distances(np.full(len(PATCHES), rho), made) for rho in (0.24, 0.4, 0.8))
    assert np.isnan(low.distance_mm).all()
    assert np.isnan(low.sigma_mm).all()
    assert (just.distance_mm > 2 * well.distance_mm).all()
    assert (just.sigma_mm > 2 * well.sigma_mm).all()


@pytest.mark.parametrize("d", [0.1, 0.3, 0.6])
def test_deviation_with_a_model_is_the_correlations_over_the_models_slope(d):
    """By finite differences of the model, whose share is uncertain."""
    cells, c, gain, tiny = 60.0, 0.3, 0.9, 1e-5
    estimator = DistanceEstimator(of_echo(speckle.curves(sigma_mm=SIGMA_MM, cells=cells)), PATCHES)

    def rho(d, c=c):
        return gain * (c + (1 - c) * np.exp(-(d**2) / (4 * SIGMA_MM**2))) ** 2

    def slope(function, at):
        return (function(at + tiny) - function(at - tiny)) / (2 * tiny)

    seen = rho(d)
    noise = 2 * seen * (1 - seen) ** 2 / cells + (1 - seen) ** 2 / cells**2 + INTERPOLATION**2
    share = SHARE_ERROR * c * slope(lambda x: rho(d, c=x), c)
    expected = np.abs(np.sqrt(noise + share**2) / slope(rho, d))
    got = estimator.sigma(np.full(len(PATCHES), d), model(c, gain))
    np.testing.assert_allclose(got[0], expected, rtol=0.03)


def ending_at(distance_mm):
    """Curves that were not measured farther than this: correlation 0.61 at 0.45 mm."""
    return DistanceEstimator(speckle.curves(sigma_mm=SIGMA_MM, largest_mm=distance_mm), PATCHES)


def test_nothing_is_read_beyond_the_last_distance_of_the_curves():
    estimator = ending_at(SIGMA_MM)
    rho = speckle.gaussian_correlation(np.linspace(0.05, 1.0, len(PATCHES)), SIGMA_MM)
    got = estimator.distances(rho)
    beyond = np.linspace(0.05, 1.0, len(PATCHES)) > SIGMA_MM
    assert np.isnan(got.distance_mm[beyond]).all()
    np.testing.assert_allclose(
        got.distance_mm[~beyond], np.linspace(0.05, 1.0, len(PATCHES))[~beyond], atol=2e-3
    )
    assert (estimator.typical_correlation(np.array([0.9])) == 0.0).all()
    assert (estimator.typical_correlation(np.array([0.3])) > 0.7).all()


def test_curves_that_have_levelled_out_say_so_at_any_distance():
    estimator = ending_at(2.0)
    assert (estimator.end_amplitude == 0.0).all()
    assert (estimator.typical_correlation(np.array([30.0])) > 0.0).all()
