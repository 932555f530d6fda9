"""Seen yaw and tilt against what an error of distances that varies over the image could feign."""

from dataclasses import replace

import numpy as np
import pytest
import speckle
from pair_planes import AT, TILT, fit_many, from_coefficients, problem_of

from speckle3d.core.poses import TURN_CHANGE_MM
from speckle3d.kernels.statistics import correlation_variance
from speckle3d.motion.planes import PlaneSettings
from speckle3d.motion.uncertainty import weigh_slopes

SIGMA_MM, CELLS = 0.45, 60.0
SETTINGS = PlaneSettings()
EXPECTED = float(np.deg2rad(SETTINGS.turn_deg_per_mm))
PHANTOM, TISSUE = 0.0016, 0.016
"""Relative deviations of distances from one side to the other, of curves from twenty blocks of phantom and of
adapted tissue."""
LONG = np.array([[0.0], [1e6]])
"""A path on which turns are steady."""
DELIBERATE = float(np.deg2rad(5.0) / 20.0)
LEVER_MM = AT[:, 0].std()


def fit_planes(yaw_per_mm=0.0, short=0.0):
    """Planes of pairs that yaw as they travel, read with distances wrong by a share of each patch's own."""
    rng, curves = np.random.default_rng(0), speckle.curves(SIGMA_MM, CELLS, key=speckle.ECHO)
    offset = rng.uniform(0.1, 0.5, (200, 1))
    rho = speckle.gaussian_correlation(offset * (1 + yaw_per_mm * AT[:, 0]) * (1 + short), SIGMA_MM)
    rho = rho + np.sqrt(correlation_variance(rho, CELLS, True)) * rng.normal(size=rho.shape)
    return fit_many(problem_of(replace(curves, tilt=TILT)), rho)[0]


def feigned(sigma):
    """Deviations of yaw and tilt per distance."""
    return np.array([sigma / LEVER_MM, sigma / AT[:, 1].std()])


def rates(planes):
    """Yaw and tilt per distance of some planes."""
    p = planes.coefficients
    return p[:, 0] @ p[:, 1:] / (p[:, 0] @ p[:, 0])


def planes_with(offset, slope_x):
    """Planes of some offsets and slopes, as even weights over the image know them."""
    covariance = np.diag([1e-5 + SETTINGS.bias_mm**2, *(1e-5 / AT.var(axis=0))])
    coefficients = np.column_stack([offset, slope_x, 0 * offset])
    return from_coefficients(0, 1, coefficients, covariance)


def test_a_false_turn_within_the_rows_errors_is_left_out():
    """Distances read 4 % long on one side and short on the other, which errors of rows feign."""
    planes = fit_planes(short=0.022 * AT[:, 0] / LEVER_MM)
    weights = weigh_slopes(planes, feigned(TISSUE), SETTINGS, LONG)
    rate, weighed_rate = abs(rates(planes)[0]), abs(rates(weights.applied(planes))[0])
    assert rate > 2.0 * EXPECTED
    assert weighed_rate < min(0.25 * rate, 1.5 * EXPECTED, 3 * weights.deviation_per_mm[0])


def test_a_turn_of_five_degrees_over_twenty_millimetres_is_believed():
    planes = fit_planes(DELIBERATE)
    weights = weigh_slopes(planes, feigned(PHANTOM), SETTINGS, LONG)
    assert weights.share[0] > 0.98
    assert abs(rates(weights.applied(planes))[0] / DELIBERATE - 1) < 0.02
    # Sides sure to 1.2 % could feign two fifths of it.
    weights = weigh_slopes(planes, feigned(0.012), SETTINGS, LONG)
    assert 0.6 < weights.share[0] < 0.95
    assert abs(rates(weights.applied(planes))[0] - DELIBERATE) < 2 * weights.deviation_per_mm[0]


@pytest.mark.parametrize(("sigma", "way_mm"), [(0.004, 1e6), (0.016, 1e6), (0.016, 8.0)])
def test_deviations_are_those_of_turns_as_expected_and_feigned(sigma, way_mm):
    """Over many sweeps whose true and false rates are drawn, kept rates miss the true by what is claimed.

    Of a wander the mean rate is the larger the shorter the way.
    """
    whole = np.sqrt(1.0 + TURN_CHANGE_MM / way_mm)
    expected, path = whole * EXPECTED, np.array([[0.0], [way_mm]])
    rng, offset = np.random.default_rng(1), np.array([0.2, 0.3, 0.4])
    feint = sigma / LEVER_MM
    off, deviations = [], []
    for true, false in rng.normal(size=(600, 2)) * [expected, feint]:
        planes = planes_with(offset, offset * (true + false))
        weights = weigh_slopes(planes, feigned(sigma), SETTINGS, path)
        off.append(rates(weights.applied(planes))[0] - true)
        deviations.append(whole * weights.deviation_per_mm[0])
    # 600 draws know a deviation to 3 %; believing what stands out costs some at the tails.
    assert 0.85 < np.std(off) / np.sqrt(np.mean(np.square(deviations))) < 1.15
    assert np.std(off) < 1.1 * min(feint, expected)
