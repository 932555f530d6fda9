"""Seen yaw and tilt against what an error of distances that varies over the image could feign."""

from dataclasses import replace

import numpy as np
import pair_planes
import pytest
import speckle

from speckle3d.core.curves import TiltResponse
from speckle3d.core.sweep import ImageGrid
from speckle3d.kernels.statistics import correlation_variance
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.distances import DistanceEstimator
from speckle3d.motion.planes import PlaneFitter, PlaneSettings
from speckle3d.motion.uncertainty import BEYOND_DOUBT, NEAR_MM, UNEVENNESS, SlopeEvidence, weigh_slopes

GRID = ImageGrid(vectors=127, samples=640, vector_pitch_mm=0.3, sample_spacing_mm=0.06)
PATCHES = lay_patches(GRID)
AT = PATCHES.centre_mm - GRID.centre_mm[:2]
SIGMA_MM, CELLS = 0.45, 60.0
TILT = TiltResponse(np.array([-9.0, 8.0]), np.array([2.0, 6.0]))
EXPECTED = float(np.deg2rad(PlaneSettings().turn_deg_per_mm))
PHANTOM, TISSUE = 0.004, 0.04
"""Relative deviations of the scale: of curves from twenty blocks of phantom, of adapted tissue."""
DELIBERATE = float(np.deg2rad(5.0) / 20.0)
LEVER_MM = AT[:, 0].std()


@pytest.fixture(scope="module")
def fitter():
    made = speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS)
    made = replace(made, key=replace(made.key, correlation_of="echo"), tilt=TILT)
    return PlaneFitter(DistanceEstimator(made, PATCHES), AT)


def fitted(fitter, yaw_per_mm=0.0, tilt_per_mm=0.0, short=0.0, pairs=60, seed=0):
    """Planes of pairs that turn as they travel, read with distances wrong by a share of each patch's own."""
    rng = np.random.default_rng(seed)
    design = fitter.design()
    spread = np.interp(PATCHES.centre_mm[:, 1], (5.0, 30.0), TILT.spread_mm)
    every = []
    for offset in rng.uniform(0.1, 0.5, pairs):
        turn = offset * np.array([yaw_per_mm, tilt_per_mm])
        z = np.hypot(design @ [offset, *turn], spread * turn[1]) * (1 + short)
        rho = speckle.gaussian_correlation(z, SIGMA_MM)
        rho = rho + np.sqrt(correlation_variance(rho, CELLS, True)) * rng.normal(size=rho.size)
        every.append(rho)
    return design, fitter.fit(np.array(every, np.float32), np.zeros((pairs, 2)))


def rates(planes):
    """Yaw and tilt per distance of some planes."""
    p = planes.coefficients
    return (p[:, 1:] * p[:, :1]).sum(axis=0) / (p[:, 0] ** 2).sum()


def made(offset, slope_x, slope_y=0.0, covariance=None):
    """Planes of one or several offsets and slopes."""
    covariance = np.diag([4e-4, 1e-8, 1e-8]) if covariance is None else covariance
    coefficients = np.column_stack(np.broadcast_arrays(np.atleast_1d(offset), slope_x, slope_y))
    return pair_planes.made(coefficients, covariance, 0.03, len(AT))


DESIGN = np.column_stack([np.ones(len(AT)), AT])


# ---- from correlations ------------------------------------------------------------------------------------


def test_a_false_turn_within_the_scales_error_is_left_out(fitter):
    """Distances read 4 % long on one side and short on the other, where the scale is sure to 4 %."""
    uneven = 0.022 * AT[:, 0] / LEVER_MM
    design, planes = fitted(fitter, short=uneven)
    seen = rates(planes)[0]
    # 2.2 % per lever of ten millimetres.
    assert abs(seen) > 2.0 * EXPECTED
    evidence = weigh_slopes(design, planes, TISSUE, EXPECTED)
    left = rates(evidence.applied(planes))[0]
    # Seen at 1.5 deviations of what may be feigned: only what sweeps are expected to have is kept.
    assert abs(left) < 0.25 * abs(seen)
    assert abs(left) < 1.5 * EXPECTED
    assert abs(left) < 3 * evidence.deviation_per_mm[0]


def test_a_turn_of_five_degrees_over_twenty_millimetres_is_believed(fitter):
    design, planes = fitted(fitter, yaw_per_mm=DELIBERATE)
    evidence = weigh_slopes(design, planes, PHANTOM, EXPECTED)
    assert evidence.share[0] > 0.98
    kept = rates(evidence.applied(planes))[0]
    # 0.1 degrees of five, from sixty pairs of slopes right to 3e-4 each over 0.3 mm.
    assert abs(kept / DELIBERATE - 1) < 0.04


def test_a_deliberate_turn_stands_out_of_what_tissue_may_feign(fitter):
    """The scale sure to 3 % could feign two fifths of it."""
    design, planes = fitted(fitter, yaw_per_mm=DELIBERATE)
    evidence = weigh_slopes(design, planes, 0.03, EXPECTED)
    assert 0.6 < evidence.share[0] < 0.95
    kept = rates(evidence.applied(planes))[0]
    assert abs(kept - DELIBERATE) < 2 * evidence.deviation_per_mm[0]


def test_no_turn_stays_none(fitter):
    design, planes = fitted(fitter)
    for sigma in (PHANTOM, TISSUE):
        evidence = weigh_slopes(design, planes, sigma, EXPECTED)
        kept = rates(evidence.applied(planes))
        # One pair's yaw and tilt are right to 3 and 6e-4 over 0.3 mm: sixty pairs know rates to 3e-4.
        assert (np.abs(kept) < 0.7 * EXPECTED).all()


def test_tilt_is_believed_less_than_yaw_for_its_lever_is_short(fitter):
    """Off the focus patches are moved by tilt as if they lay there: seven millimetres of lever, not ten."""
    design, planes = fitted(fitter)
    evidence = weigh_slopes(design, planes, PHANTOM, EXPECTED)
    assert evidence.share[1] < evidence.share[0]
    assert evidence.deviation_per_mm[1] > 1.5 * evidence.deviation_per_mm[0]


def test_curves_that_know_nothing_of_tilt_leave_none_of_it(fitter):
    plain = PlaneFitter(
        DistanceEstimator(speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS), PATCHES), AT, PlaneSettings()
    )
    rho = speckle.gaussian_correlation(np.full(len(AT), 0.3), SIGMA_MM)
    planes = plain.fit(np.array([rho] * 3, np.float32), np.zeros((3, 2)))
    evidence = weigh_slopes(plain.design(), planes, PHANTOM, EXPECTED)
    assert evidence.share[1] < 1e-6
    # What is left is what sweeps are expected to have.
    assert abs(evidence.deviation_per_mm[1] / EXPECTED - 1) < 0.01


# ---- the law ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.01, 0.02, 0.04])
def test_deviations_are_those_of_turns_as_expected_and_feigned(sigma):
    """Over many sweeps whose true and false rates are drawn, kept rates miss the true by what is claimed."""
    rng = np.random.default_rng(1)
    feigned = UNEVENNESS * sigma / LEVER_MM
    true = EXPECTED * rng.normal(size=600)
    false = feigned * rng.normal(size=600)
    off, claimed = [], []
    for one, other in zip(true, false, strict=True):
        offset = np.array([0.2, 0.3, 0.4])
        planes = made(offset, offset * (one + other))
        evidence = weigh_slopes(DESIGN, planes, sigma, EXPECTED)
        off.append(rates(evidence.applied(planes))[0] - one)
        claimed.append(evidence.deviation_per_mm[0])
    # 600 draws know a deviation to 3 %; believing what stands out costs some at the tails.
    assert 0.85 < np.std(off) / np.sqrt(np.mean(np.square(claimed))) < 1.15
    # And it is better than believing all or nothing.
    assert np.std(off) < 1.1 * min(feigned, EXPECTED)


def test_what_stands_out_beyond_doubt_is_believed_whatever_sweeps_are_expected_to_have():
    feigned = UNEVENNESS * TISSUE / LEVER_MM
    shares = []
    for deviations in (0.5, 1.5, 3.0, 6.0, 30.0):
        offset = np.array([0.2, 0.4])
        planes = made(offset, offset * deviations * feigned)
        shares.append(weigh_slopes(DESIGN, planes, TISSUE, EXPECTED).share[0])
    assert shares[0] == shares[1] < 0.5
    assert 1.5 < BEYOND_DOUBT < 3.0
    assert (np.diff(shares[1:]) > 0).all()
    assert shares[-1] > 0.99


def test_the_sign_that_planes_happen_to_have_does_not_matter():
    """Every plane has a >= 0, on either side: a turn that goes with the travel has b of the same sign."""
    offset = np.array([0.2, 0.3])
    there, back = (made(offset, s * 0.01 * offset) for s in (1.0, -1.0))
    evidence = [weigh_slopes(DESIGN, planes, TISSUE, EXPECTED) for planes in (there, back)]
    np.testing.assert_allclose(evidence[0].share, evidence[1].share)


def test_patches_that_took_no_part_have_no_lever():
    narrow = np.abs(AT[:, 0]) < 5.0
    planes = made([0.3] * 3, 0.0)
    cut = replace(planes, sigma_mm=np.where(narrow, planes.sigma_mm, np.nan))
    whole, less = (weigh_slopes(DESIGN, p, TISSUE, EXPECTED) for p in (planes, cut))
    assert less.share[0] < 0.5 * whole.share[0]


def test_keeping_part_of_a_slope_moves_the_offset_as_the_fit_has_it():
    """The same as fitting anew with the slopes held."""
    root = np.array([[0.02, 0, 0], [2e-4, 4e-4, 0], [-3e-4, 1e-4, 5e-4]])
    covariance = root @ root.T
    plane = made(0.3, 0.004, -0.006, covariance)
    share = np.array([0.25, 0.7])
    found = SlopeEvidence(share, np.zeros(2)).applied(plane)
    held = share * plane.coefficients[0, 1:]
    information = np.linalg.inv(covariance)
    # Of (x - x0)' W (x - x0) with b and c held, the least over a.
    offset = 0.3 - information[0, 1:] @ (held - plane.coefficients[0, 1:]) / information[0, 0]
    np.testing.assert_allclose(found.coefficients, [[offset, *held]], rtol=1e-9)
    assert found.covariance[0, 0, 0] < covariance[0, 0]
    np.testing.assert_allclose(found.covariance[0], found.covariance[0].T)


def test_all_of_a_slope_kept_is_the_plane_itself():
    plane = made(0.3, 0.004, -0.006)
    found = SlopeEvidence(np.ones(2), np.zeros(2)).applied(plane)
    np.testing.assert_allclose(found.coefficients, plane.coefficients)
    np.testing.assert_allclose(found.covariance, plane.covariance)


def test_the_deviation_left_grows_with_distance_and_never_vanishes():
    evidence = SlopeEvidence(np.ones(2), np.array([1e-3, 2e-3]))
    for offset, counted in ((0.01, NEAR_MM), (0.5, 0.5)):
        plane = made(offset, 0.0)
        (added,) = evidence.applied(plane).covariance - plane.covariance
        np.testing.assert_allclose(added, np.diag([0.0, (1e-3 * counted) ** 2, (2e-3 * counted) ** 2]))


def test_a_plane_that_changes_side_is_turned_over():
    """Without its slopes the offset would be negative: planes are kept with a >= 0."""
    covariance = np.array([[4e-4, 1.9e-5, 0.0], [1.9e-5, 1e-6, 0.0], [0.0, 0.0, 1e-6]])
    plane = made(0.05, 0.01, 0.002, covariance)
    found = SlopeEvidence(np.array([0.5, 1.0]), np.zeros(2)).applied(plane)
    np.testing.assert_allclose(found.coefficients, [[0.045, -0.005, -0.002]])
