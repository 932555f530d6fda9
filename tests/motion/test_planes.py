"""Planes fitted to correlations drawn about a plane's own, by several laws of noise."""

from dataclasses import replace

import numpy as np
import pytest
import speckle
from pair_planes import fit, pair

from speckle3d.core.curves import TiltResponse
from speckle3d.core.sweep import ImageGrid
from speckle3d.kernels.statistics import correlation_variance
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.distances import DistanceEstimator
from speckle3d.motion.planes import PlaneFitter, PlaneSettings

GRID = ImageGrid(vectors=127, samples=640, vector_pitch_mm=0.3, sample_spacing_mm=0.06)
PATCHES = lay_patches(GRID)
AT = PATCHES.centre_mm - GRID.centre_mm[:2]
SIGMA_MM, CELLS = 0.45, 50
STILL = np.zeros(2)
TILT = TiltResponse(np.array([-9.0, 8.0]), np.array([2.0, 6.0]))
"""As a linear probe's: turning is about a point near the focus, some seven millimetres off at either end."""
PLANES = [(0.3, 0.0, 0.0), (0.25, 0.006, 0.0), (0.35, -0.003, 0.008), (0.3, 0.002, -0.01)]
CROSSING = [(0.0, 0.03, 0.0), (0.1, 0.03, 0.0), (0.3, -0.03, 0.0), (0.1, 0.015, 0.004), (0.2, 0.05, 0.0)]
PARALLEL = [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.1, 0.0, 0.0), (0.3, 0.006, 0.0), (0.3, 0.015, 0.0)]


def fitter_of(of="echo", tilt=TILT, bias_mm=0.02):
    made = speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS)
    made = replace(made, key=replace(made.key, correlation_of=of), tilt=tilt)
    return PlaneFitter(DistanceEstimator(made, PATCHES), AT, PlaneSettings(bias_mm=bias_mm))


def patch_distances(plane, tilt=TILT):
    """Distance without tilt at which each patch's speckle would decorrelate as much."""
    a, b, c = plane
    z = a + b * AT[:, 0] + c * AT[:, 1]
    if tilt is None:
        return np.abs(z)
    depth = PATCHES.centre_mm[:, 1]
    pivot, spread = (np.interp(depth, (5.0, 30.0), values) for values in (tilt.pivot_mm, tilt.spread_mm))
    return np.hypot(z - pivot * c, spread * c)


def correlations(plane, tilt=TILT):
    return speckle.gaussian_correlation(patch_distances(plane, tilt), SIGMA_MM)


def drawn(rho, rng, law="gaussian", of_echo=True):
    """Correlations with the variance of `CELLS` cells: Gaussian, heavy-tailed, or speckle's own."""
    deviation = np.sqrt(correlation_variance(rho, CELLS, of_echo))
    if law == "gaussian":
        return rho + deviation * rng.normal(size=rho.shape)
    if law == "heavy":
        return rho + deviation * rng.standard_t(4, size=rho.shape) / np.sqrt(2.0)
    a, b = rng.normal(size=(2, *rho.shape, CELLS, 2)) @ np.array([1.0, 1.0j])
    b = np.sqrt(rho)[:, None] * a + np.sqrt(1.0 - rho)[:, None] * b
    power = (np.abs(a) ** 2).sum(axis=1) * (np.abs(b) ** 2).sum(axis=1)
    # Chance adds (1 - rho)^2 / N, which curves of the same phantom hold.
    return np.abs((a * b.conj()).sum(axis=1)) ** 2 / power - (1.0 - rho) ** 2 / CELLS


def fits(fitter, plane, draws, law="gaussian", of="echo", tilt=TILT):
    rng = np.random.default_rng(1)
    rho = correlations(plane, tilt)
    every = np.array([drawn(rho, rng, law, of == "echo") for _ in range(draws)], np.float32)
    planes = fitter.fit(every, np.zeros((draws, 2)))
    return [pair(planes, k) for k in range(draws)]


# ---- one side ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plane", [*PLANES, (0.9, 0.005, 0.01)])
def test_correlations_of_a_plane_give_it_back(plane):
    found = fit(fitter_of(), correlations(plane), STILL)
    # Steps end when the cost no longer falls by a millionth of itself; the slopes' prior pulls by less.
    np.testing.assert_allclose(found.coefficients, plane, atol=2e-4)
    assert found.used.all()
    assert np.abs(found.excess_mm).max() < 1e-3


def test_in_plane_motion_shifts_the_patches_with_the_second_frame():
    moved = np.array([1.5, -0.8])
    a, b, c = 0.3, 0.008, 0.006
    there = a + b * (AT[:, 0] - moved[0]) + c * (AT[:, 1] - moved[1])
    pivot = np.interp(PATCHES.centre_mm[:, 1], (5.0, 30.0), TILT.pivot_mm)
    spread = np.interp(PATCHES.centre_mm[:, 1], (5.0, 30.0), TILT.spread_mm)
    rho = speckle.gaussian_correlation(np.hypot(there - pivot * c, spread * c), SIGMA_MM)
    fitter = fitter_of()
    np.testing.assert_allclose(fit(fitter, rho, moved).coefficients, (a, b, c), atol=2e-4)
    centre = a - b * moved[0] - c * moved[1]
    np.testing.assert_allclose(fit(fitter, rho, STILL).offset_mm, centre, atol=5e-4)


def test_curves_that_know_nothing_of_tilt_say_nothing_of_it():
    """All depths then see the centre's distance, and tilt is left to what is expected of it."""
    found = fit(fitter_of(tilt=None), correlations((0.3, 0.006, 0.0), None), STILL)
    np.testing.assert_allclose(found.coefficients, (0.3, 0.006, 0.0), atol=2e-4)
    assert np.sqrt(found.covariance[2, 2]) > 0.04
    assert np.sqrt(fit(fitter_of(), correlations(PLANES[0]), STILL).covariance[2, 2]) < 0.002


def test_the_offset_is_told_positive_though_the_patches_lie_beyond_the_crossing():
    """Frames that cross left of all the patches used: seen from either side, the centre is 0.05 mm away."""
    truth = np.array([-0.05, 0.03, 0.0])
    rho = np.where(AT[:, 0] > 3.0, correlations(truth), np.nan)
    found = fit(fitter_of(), rho, STILL)
    np.testing.assert_allclose(found.coefficients, -truth, atol=5e-4)


@pytest.mark.parametrize("of", ["echo", "intensity"])
@pytest.mark.parametrize("plane", [(0.1, 0.0, 0.0), *PLANES, (0.6, 0.002, 0.0), (0.9, 0.0, 0.0)])
def test_planes_from_noisy_correlations_are_unbiased(plane, of):
    """The last at two widths of the curve, where an eighth of the correlation is left."""
    found = np.array([f.coefficients for f in fits(fitter_of(of), plane, 150, of=of)])
    # One draw is off by 2 to 4 %: 0.3 % after 150. The curve's bend leaves a few thousandths more.
    assert abs(found[:, 0].mean() / plane[0] - 1) < 0.01
    # One draw's slopes are off by 3e-4 to 3e-3; a mean that is a third of a deviation off shows in 150.
    assert (np.abs(found.mean(axis=0) - plane)[1:] < 0.7 * found.std(axis=0)[1:]).all()


def test_where_speckle_has_all_but_gone_distances_would_be_missing_but_planes_are_not():
    plane = (1.1, 0.004, 0.01)
    fitter = fitter_of()
    rng = np.random.default_rng(2)
    estimator = DistanceEstimator(speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS), PATCHES)
    lost, averages = [], []
    for _ in range(60):
        read = estimator.distances(drawn(correlations(plane), rng)[None]).distance_mm
        lost.append(np.isnan(read).mean())
        averages.append(np.nanmean(read) / patch_distances(plane).mean())
    found = np.array([f.offset_mm for f in fits(fitter, plane, 150)])
    # A third of the patches are under the least correlation, and those are the far ones.
    assert np.mean(lost) > 0.2
    assert np.mean(averages) < 0.95
    assert abs(found.mean() / plane[0] - 1) < 0.02


@pytest.mark.parametrize("of", ["echo", "intensity"])
@pytest.mark.parametrize("plane", [PLANES[1], PLANES[2], (0.6, 0.002, 0.0)])
def test_covariance_covers_the_truth_as_often_as_it_says(plane, of):
    found = fits(fitter_of(of, bias_mm=0.0), plane, 300, of=of)
    off = np.array([f.coefficients for f in found]) - plane
    deviation = np.sqrt([np.diag(f.covariance) for f in found])
    # 300 draws know 68 % to 2.7 and 95 % to 1.3 points (three times that below); robust weights and the
    # floor under interpolation make claims 0 to 15 % too wide, which adds up to 7 points.
    inside = (np.abs(off) < deviation).mean(axis=0)
    assert ((inside > 0.60) & (inside < 0.83)).all(), inside
    inside = (np.abs(off) < 1.96 * deviation).mean(axis=0)
    assert ((inside > 0.91) & (inside < 0.99)).all(), inside


@pytest.mark.parametrize("law", ["heavy", "speckle"])
@pytest.mark.parametrize("plane", [(0.1, 0.0, 0.0), PLANES[2], (0.6, 0.002, 0.0)])
def test_other_laws_of_noise_than_assumed_do_no_harm(plane, law):
    """Student's t of four degrees of freedom, and correlations of fifty complex Gaussian cells."""
    found = fits(fitter_of(bias_mm=0.0), plane, 150, law)
    coefficients = np.array([f.coefficients for f in found])
    deviation = np.sqrt([np.diag(f.covariance) for f in found])
    gaussian = np.array([f.coefficients for f in fits(fitter_of(bias_mm=0.0), plane, 150)])
    assert abs(coefficients[:, 0].mean() / plane[0] - 1) < 0.01
    # Of equal variance, heavy tails are the easier noise for weights that let go of them.
    assert (coefficients.std(axis=0) < 1.15 * gaussian.std(axis=0)).all()
    inside = (np.abs(coefficients - plane) < 1.96 * deviation).mean(axis=0)
    assert (inside > 0.9).all(), inside


def test_the_common_bias_is_part_of_the_offsets_variance_alone():
    rho = correlations(PLANES[0])
    without, with_it = (fit(fitter_of(bias_mm=b), rho, STILL).covariance for b in (0.0, 0.05))
    added = np.zeros((3, 3))
    added[0, 0] = 0.05**2
    np.testing.assert_allclose(with_it - without, added, atol=1e-12)


# ---- patches ----------------------------------------------------------------------------------------------


def test_excess_is_how_much_farther_a_patch_is():
    plane = PLANES[2]
    fitter = fitter_of()
    rho = correlations(plane)
    farther, nearer = 30, 71
    for patch, change in ((farther, 0.03), (nearer, -0.03)):
        rho[patch] = speckle.gaussian_correlation(patch_distances(plane)[patch] + change, SIGMA_MM)
    rho[5] = np.nan
    found = fit(fitter, rho, STILL)
    # To first order in the correlation, whose slope changes by a twentieth over 0.03 mm, less the hundredth
    # part of it that one of 120 patches moves the plane.
    np.testing.assert_allclose(found.excess_mm[[farther, nearer]], [0.03, -0.03], rtol=0.15)
    others = np.delete(found.excess_mm, [5, farther, nearer])
    assert np.abs(others).max() < 2e-3
    assert np.isnan(found.excess_mm[5])
    assert np.isnan(found.sigma_mm[5])


def test_excess_counts_outwards_on_either_side_of_a_crossing():
    plane = (0.0, 0.03, 0.0)
    rho = correlations(plane)
    patches = [int(np.argmin(np.hypot(*(AT - at).T))) for at in ([-12, 0], [12, 0])]
    rho[patches] = speckle.gaussian_correlation(patch_distances(plane)[patches] + 0.02, SIGMA_MM)
    found = fit(fitter_of(), rho, STILL)
    np.testing.assert_allclose(found.excess_mm[patches], 0.02, rtol=0.15)


@pytest.mark.parametrize("of", ["echo", "intensity"])
def test_a_patchs_deviation_is_that_of_its_excess(of):
    plane = (0.4, 0.006, 0.0)
    found = fits(fitter_of(of), plane, 200, of=of)
    excess = np.array([f.excess_mm for f in found])
    spread = np.median(np.abs(excess), axis=0) / 0.6745
    claimed = np.median([f.sigma_mm for f in found], axis=0)
    # A deviation from 200 draws is known to 6 %, three times that for the worst of 120 patches.
    np.testing.assert_allclose(claimed, spread, rtol=0.3)
    assert abs(np.median(claimed / spread) - 1) < 0.05


def test_outliers_do_not_move_the_plane():
    rng = np.random.default_rng(4)
    fitter = fitter_of()
    for plane in PLANES:
        rho = drawn(correlations(plane), rng)
        before = fit(fitter, rho, STILL)
        outlying = rng.choice(rho.size, rho.size // 10, replace=False)
        rho[outlying] *= 0.3
        after = fit(fitter, rho, STILL)
        # Huber's weights leave a tenth of outliers the pull of two deviations each: 0.2 of 0.05 mm.
        assert abs(after.offset_mm - before.offset_mm) < 0.015
        assert np.abs(after.coefficients - before.coefficients)[1:].max() < 0.002
        assert after.excess_mm[outlying].min() > 2.0 * after.sigma_mm[outlying].max()
        # What does not fit is not used to claim certainty.
        assert (np.diag(after.covariance) > np.diag(before.covariance)).all()


def test_patches_without_correlation_and_outside_the_subset_take_no_part():
    rho = correlations(PLANES[1])
    subset = AT[:, 0] < 5.0
    rho[~subset] = 0.1
    rho[:3] = np.nan
    found = fit(fitter_of(), rho, STILL, subset=subset)
    np.testing.assert_allclose(found.coefficients, PLANES[1], atol=2e-4)
    assert np.array_equal(found.used, subset & np.isfinite(rho))
    assert np.array_equal(np.isfinite(found.sigma_mm), found.used)
    assert np.array_equal(np.isfinite(found.excess_mm), found.used)


def test_fewer_than_six_patches_make_no_plane():
    rho = np.full(len(AT), np.nan)
    rho[:5] = 0.8
    assert fit(fitter_of(), rho, STILL) is None
    rho[5] = 0.8
    assert fit(fitter_of(), rho, STILL) is not None


def test_what_stays_is_allowed_for():
    """Half the patches hold a coherent share, all of them noise."""
    plane = PLANES[1]
    some = np.arange(len(AT)) % 2 == 0
    share, gain = np.where(some, 0.4, 0.0), np.full(len(AT), 0.95)
    coherence = Coherence(np.zeros(1), share[None], gain[None], 0.02)
    g = np.sqrt(speckle.gaussian_correlation(patch_distances(plane), SIGMA_MM))
    rho = 0.95 * (share + (1.0 - share) * g) ** 2
    fitter = fitter_of()
    found = fit(fitter, rho, STILL, coherence=coherence)
    np.testing.assert_allclose(found.coefficients, plane, atol=5e-4)
    assert np.abs(fit(fitter, rho, STILL).coefficients - plane)[1:].max() > 1.5e-3
    # A share is not known exactly, so such patches tell less.
    assert np.median(found.sigma_mm[some]) > 1.3 * np.median(found.sigma_mm[~some])


# ---- crossing ---------------------------------------------------------------------------------------------


def spoiled(rho, rng, share):
    """Some patches' correlations at random: shadows, and structures that only one of the frames shows."""
    outlying = rng.choice(rho.size, int(share * rho.size), replace=False)
    rho[outlying] = rng.uniform(0.0, 1.0, outlying.size)
    return rho


def crosses(plane):
    z = plane.offset_mm + plane.slope_x * AT[:, 0]
    return bool((z > 0).any() and (z < 0).any())


@pytest.mark.parametrize("of", ["echo", "intensity"])
@pytest.mark.parametrize("plane", CROSSING)
def test_frames_that_cross_are_told_by_their_v_of_distances(plane, of):
    fitter = fitter_of(of)
    for found in fits(fitter, plane, 40, of=of):
        assert crosses(found)
        sign = 1.0 if plane[0] > 0 or found.slope_x * plane[1] > 0 else -1.0
        # Four or five deviations of one draw: 0.006 mm, and a tenth of that per millimetre aside.
        assert abs(sign * found.offset_mm - plane[0]) < 0.03
        assert abs(sign * found.slope_x - plane[1]) < 0.003


@pytest.mark.parametrize("law", ["gaussian", "heavy", "speckle"])
@pytest.mark.parametrize("plane", PARALLEL)
def test_frames_that_do_not_cross_are_not_taken_to(plane, law):
    # By a BIC of six and the V's shape, the chance is a few in a thousand; none of 60 is expected.
    found = [f for f in fits(fitter_of(), plane, 60, law) if crosses(f) and abs(f.slope_x) > 0.003]
    assert len(found) <= 1


@pytest.mark.parametrize("plane", CROSSING[:4])
def test_a_few_lost_patches_on_the_crossing_line_do_not_hide_it(plane):
    """There correlation is known to 0.002: one patch without it is hundreds of deviations off."""
    fitter = fitter_of()
    for seed in range(30):
        rng = np.random.default_rng(seed)
        found = fit(fitter, spoiled(drawn(correlations(plane), rng), rng, 0.08), STILL)
        assert crosses(found), seed
        assert abs(abs(found.slope_x) - abs(plane[1])) < 0.004


def test_lost_patches_do_not_make_frames_cross():
    fitter = fitter_of()
    for plane in PARALLEL[1:4]:
        for seed in range(20):
            rng = np.random.default_rng(seed)
            found = fit(fitter, spoiled(drawn(correlations(plane), rng), rng, 0.08), STILL)
            assert not crosses(found), (plane, seed)


# ---- orientation ------------------------------------------------------------------------------------------

SENSED = [(-0.1, 0.03, 0.0), (0.1, 0.02, 0.02), (-0.1, 0.02, 0.02), (-0.3, 0.01, 0.01), (0.05, 0.02, -0.02)]


@pytest.mark.parametrize("plane", SENSED)
def test_known_slopes_are_kept_and_tell_the_side(plane):
    """Crossing along both axes is resolved, and the offset keeps the sign that goes with the slopes."""
    fitter, rng = fitter_of(), np.random.default_rng(5)
    slopes = np.array(plane[1:])
    for _ in range(40):
        found = fit(fitter, drawn(correlations(plane), rng), STILL, slopes=slopes)
        # Four deviations of one draw.
        assert abs(found.offset_mm - plane[0]) < 0.01
        # The sensor is trusted to 5e-4, the images tell slopes of frames so near to 2 to 6e-4.
        assert np.abs(found.coefficients[1:] - slopes).max() < 1.5e-3


def test_known_slopes_hold_against_patches_that_under_read():
    """On one side speckle decorrelates too slowly, and the free plane turns."""
    fitter = fitter_of()
    rho = correlations((0.4, 0.0, 0.0))
    slow = AT[:, 0] > 5.0
    rho[slow] = speckle.gaussian_correlation(0.8 * 0.4, SIGMA_MM)
    free, held = fit(fitter, rho, STILL), fit(fitter, rho, STILL, slopes=np.zeros(2))
    assert abs(free.slope_x) > 0.003
    # A sensor that is sure to 5e-4 against images that claim 3e-4.
    assert abs(held.slope_x) < 0.75 * abs(free.slope_x)
    assert held.covariance[1, 1] < 0.8 * free.covariance[1, 1]


def test_a_side_that_a_sensor_has_wrong_is_not_forced():
    """Slopes of the mirror image put every patch on the wrong side of where the correlations have it."""
    plane = np.array([0.1, 0.03, 0.0])
    mirrored = fit(fitter_of(), correlations(plane), STILL, slopes=-plane[1:])
    np.testing.assert_allclose(mirrored.coefficients, -plane, atol=1e-3)


@pytest.mark.parametrize("start_mm", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("plane", [*PLANES, (0.02, 0.0, 0.0), (0.6, 0.002, 0.0), (0.9, 0.0, 0.0)])
def test_a_wrong_guess_of_the_distance_does_no_harm(plane, start_mm):
    """A path may have frames together that are apart: from nothing, a tilt would explain it, too."""
    rho = correlations(plane)
    fitter = fitter_of()
    for seed in range(5):
        noisy = drawn(rho, np.random.default_rng(seed))
        one, other = fit(fitter, noisy, STILL), fit(fitter, noisy, STILL, start_mm=start_mm)
        # Steps end within a deviation, of 1.5 % of the distance, from the minimum.
        assert abs(one.offset_mm - other.offset_mm) < 0.015 * plane[0] + 1e-3


@pytest.mark.parametrize("start_mm", [0.0, 0.3])
def test_a_guess_does_not_make_frames_cross(start_mm):
    fitter = fitter_of()
    for plane in PARALLEL[:4]:
        rng = np.random.default_rng(7)
        found = [fit(fitter, drawn(correlations(plane), rng), STILL, start_mm=start_mm) for _ in range(20)]
        assert not any(crosses(f) and abs(f.slope_x) > 0.003 for f in found)


def test_a_side_that_is_settled_is_held():
    """The offset starts on the slopes' own side alone; a mirror image that fits better is not looked for."""
    plane, fitter = np.array([0.3, 0.006, 0.0]), fitter_of()
    turned = fit(fitter, correlations(plane), STILL, slopes=-plane[1:])
    held = fit(fitter, correlations(plane), STILL, slopes=-plane[1:], either_side=False)
    np.testing.assert_allclose(turned.coefficients, -plane, atol=1e-3)
    assert held.offset_mm > 0.25


def test_patches_beyond_the_last_distance_of_the_curves_take_no_part():
    made = speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS, largest_mm=0.5)
    fitter = PlaneFitter(DistanceEstimator(made, PATCHES), AT, PlaneSettings())
    plane = (0.45, 0.02, 0.0)
    found = fit(fitter, correlations(plane, None), STILL)
    far = patch_distances(plane, None) > 0.5
    assert 0.3 < far.mean() < 0.7
    np.testing.assert_array_equal(found.used, ~far)
    np.testing.assert_allclose(found.coefficients, plane, atol=5e-3)
    assert fit(fitter, correlations((0.9, 0.0, 0.0), None), STILL) is None
