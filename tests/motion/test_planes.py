"""Planes fitted to correlations drawn about a plane's own, by several laws of noise."""

from dataclasses import replace

import numpy as np
import pytest
import speckle
from pair_planes import AT, PATCHES, TILT, fit, fit_many, problem_of

from speckle3d.kernels.statistics import correlation_variance

SIGMA_MM, CELLS = 0.45, 50
PLANES = [(0.3, 0.0, 0.0), (0.25, 0.006, 0.0), (0.35, -0.003, 0.008), (0.9, 0.005, 0.005)]
CROSSING = [(0.0, 0.03, 0.0), (0.1, 0.03, 0.0), (0.3, -0.03, 0.0), (0.1, 0.015, 0.004)]
PARALLEL = [(0.02, 0.0, 0.0), (0.1, 0.0, 0.0), (0.3, 0.006, 0.0), (0.3, 0.015, 0.0)]


def problem(of="echo", tilt=TILT, bias_mm=0.02, **curves):
    key = speckle.ECHO if of == "echo" else speckle.KEY
    phantom = speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS, key=key, **curves)
    return problem_of(replace(phantom, tilt=tilt), bias_mm=bias_mm)


def distances(plane, tilt=TILT, at=AT):
    """Distance without tilt at which each patch's speckle would decorrelate as much."""
    z = plane[0] + at @ plane[1:]
    if tilt is None:
        return np.abs(z)
    depth = PATCHES.centre_mm[:, 1]
    pivot, spread = (np.interp(depth, (5.0, 30.0), values) for values in (tilt.pivot_mm, tilt.spread_mm))
    return np.hypot(z - pivot * plane[2], spread * plane[2])


def correlations(plane, tilt=TILT):
    return speckle.gaussian_correlation(distances(plane, tilt), SIGMA_MM)


def draw(rho, rng, law="gaussian", of_echo=True):
    """Correlations with the variance of `CELLS` cells: Gaussian, or speckle's own."""
    deviation = np.sqrt(correlation_variance(rho, CELLS, of_echo))
    if law == "gaussian":
        return rho + deviation * rng.normal(size=rho.shape)
    a, b = rng.normal(size=(2, *rho.shape, CELLS, 2)) @ np.array([1.0, 1.0j])
    b = np.sqrt(rho)[..., None] * a + np.sqrt(1.0 - rho)[..., None] * b
    power = (np.abs(a) ** 2).sum(axis=-1) * (np.abs(b) ** 2).sum(axis=-1)
    # Chance adds (1 - rho)^2 / N, which curves of the same phantom hold.
    return np.abs((a * b.conj()).sum(axis=-1)) ** 2 / power - (1.0 - rho) ** 2 / CELLS


def fits(problem_, plane, draws, law="gaussian", spoilt=0.0):
    """Coefficients and deviations of many draws; a share of the patches holds chance alone."""
    rng, of_echo = np.random.default_rng(1), problem_.at_patches.of_echo
    rho = draw(np.tile(correlations(plane), (draws, 1)), rng, law, of_echo)
    rho = np.where(rng.random(rho.shape) < spoilt, rng.random(rho.shape), rho)
    planes, has_plane = fit_many(problem_, rho)
    assert has_plane.all()
    return planes.coefficients, np.sqrt(np.diagonal(planes.covariance, axis1=1, axis2=2))


def crossing(coefficients):
    z = coefficients[:, :1] + coefficients[:, 1:2] * AT[:, 0]
    return (z > 0).any(axis=1) & (z < 0).any(axis=1) & (np.abs(coefficients[:, 1]) > 0.003)


@pytest.mark.parametrize("plane", PLANES)
def test_correlations_of_a_plane_give_it_back(plane):
    estimate = fit(problem(), correlations(plane))
    np.testing.assert_allclose(estimate.coefficients, plane, atol=2e-4)
    assert estimate.used.all()


def test_in_plane_motion_shifts_the_patches_with_the_second_frame():
    shift, plane = np.array([1.5, -0.8]), (0.3, 0.008, 0.006)
    rho = speckle.gaussian_correlation(distances(plane, at=AT - shift), SIGMA_MM)
    np.testing.assert_allclose(fit(problem(), rho, shift).coefficients, plane, atol=2e-4)
    assert abs(fit(problem(), rho).offset_mm - plane[0]) > 0.005


def test_curves_that_know_nothing_of_tilt_say_nothing_of_it():
    estimate = fit(problem(tilt=None), correlations((0.3, 0.006, 0.0), None))
    np.testing.assert_allclose(estimate.coefficients, (0.3, 0.006, 0.0), atol=2e-4)
    assert np.sqrt(estimate.covariance[2, 2]) > 0.01
    assert np.sqrt(fit(problem(), correlations(PLANES[0])).covariance[2, 2]) < 0.002


@pytest.mark.parametrize("of", ["echo", "intensity"])
@pytest.mark.parametrize("plane", [(0.1, 0.0, 0.0), PLANES[2], (0.6, 0.002, 0.0), (0.9, 0.0, 0.0)])
def test_planes_are_unbiased_and_their_covariance_covers_the_truth(plane, of):
    """The last at two widths of the curve, where an eighth of the correlation is left."""
    coefficients, deviation = fits(problem(of, bias_mm=0.0), plane, 200)
    # One draw is off by 2 to 4 %: 0.3 % after 200. The curve's bend leaves a few thousandths more.
    assert abs(coefficients[:, 0].mean() / plane[0] - 1) < 0.01
    # 200 draws know 68 % to 3.3 points; robust weights and the floor under interpolation widen claims, the
    # curve's bend near no distance and far out narrows them.
    inside = (np.abs(coefficients - plane) < deviation).mean(axis=0)
    assert ((inside > (0.6 if 0.2 < plane[0] < 0.8 else 0.5)) & (inside < 0.85)).all(), inside


def test_outliers_do_not_move_the_plane():
    rng, rho = np.random.default_rng(4), correlations(PLANES[2])
    before = fit(problem(), rho)
    rho[rng.choice(rho.size, rho.size // 10, replace=False)] *= 0.3
    after = fit(problem(), rho)
    # Huber's weights leave a tenth of outliers the pull of two deviations each: 0.2 of 0.05 mm.
    assert abs(after.offset_mm - before.offset_mm) < 0.015
    assert (np.diag(after.covariance) > np.diag(before.covariance)).all()


def test_patches_without_correlation_outside_the_subset_or_beyond_the_curves_take_no_part():
    rho, subset = correlations(PLANES[1]), AT[:, 0] < 5.0
    rho[~subset], rho[:3] = 0.1, np.nan
    estimate = fit(problem(), rho, subset=subset)
    np.testing.assert_allclose(estimate.coefficients, PLANES[1], atol=2e-4)
    np.testing.assert_array_equal(estimate.used, subset & np.isfinite(rho))
    short, plane = problem(tilt=None, largest_mm=0.5), (0.45, 0.02, 0.0)
    estimate = fit(short, correlations(plane, None))
    np.testing.assert_array_equal(estimate.used, distances(plane, None) <= 0.5)
    np.testing.assert_allclose(estimate.coefficients, plane, atol=5e-3)
    assert fit(short, correlations((0.9, 0.0, 0.0), None)) is None


def test_three_patches_make_no_plane():
    rho = np.full(len(AT), np.nan)
    rho[:3] = 0.8
    assert fit(problem(), rho) is None
    rho[3] = 0.8
    assert fit(problem(), rho) is not None


@pytest.mark.parametrize("plane", CROSSING)
def test_frames_that_cross_are_told_by_their_v_of_distances(plane):
    """Even where a few patches on the line have lost their correlation."""
    for spoilt in (0.0, 0.08):
        coefficients, _ = fits(problem(), plane, 40, spoilt=spoilt)
        assert crossing(coefficients).all()
        coefficients *= np.sign(coefficients[:, 1:2] * plane[1])
        # A deviation is 0.006 mm, and a tenth of that per millimetre aside; more where patches are lost.
        off = np.abs(coefficients[:, :2] - plane[:2]).max(axis=0)
        assert (off < np.array([0.04, 0.004]) * (2.0 if spoilt else 1.0)).all()


@pytest.mark.parametrize("plane", PARALLEL)
def test_frames_that_do_not_cross_are_not_taken_to(plane):
    laws = [("gaussian", 0.0), ("speckle", 0.0), *([("gaussian", 0.08)] if plane[1] < 0.01 else [])]
    for law, spoilt in laws:
        # By a BIC of six and the V's shape, the chance is a few in a thousand.
        assert crossing(fits(problem(), plane, 60, law, spoilt)[0]).sum() <= 1


@pytest.mark.parametrize("plane", [(-0.1, 0.03, 0.0), (0.1, 0.02, 0.02), (-0.3, 0.01, 0.01)])
def test_known_slopes_are_kept_and_tell_the_side(plane):
    rho = draw(np.tile(correlations(plane), (40, 1)), np.random.default_rng(5))
    planes, _ = fit_many(problem(), rho, slopes=np.tile(plane[1:], (40, 1)))
    assert np.abs(planes.offset_mm - plane[0]).max() < 0.01
    # The sensor is trusted to 5e-4, the images tell slopes of frames so near to 2 to 6e-4.
    assert np.abs(planes.coefficients[:, 1:] - plane[1:]).max() < 1.5e-3
