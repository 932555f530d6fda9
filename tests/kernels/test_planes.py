"""Planes of pairs against one pair at a time in NumPy."""

import numpy as np
import oracles
import pytest

from speckle3d.kernels.plane_misfit import EchoModels, FitRules, Levers
from speckle3d.kernels.planes import FittedPlanes, agreeing_patches, fit_planes
from speckle3d.kernels.statistics import PatchCurves

STEP_MM, PATCHES, PAIRS = 0.01, 37, 24
GRID_MM = np.arange(0, 3.0, STEP_MM)
LEVERS = Levers(
    np.repeat(np.linspace(-15.0, 15.0, PATCHES), 1),
    np.linspace(-7.0, 9.0, PATCHES),
    np.linspace(2.0, 6.0, PATCHES),
)


def scene(rng, of_echo):
    """Correlations of pairs that cross in the image or do not, some of whose patches take no part."""
    width = rng.uniform(0.4, 0.7, (PATCHES, 1))
    curves = PatchCurves(1 / (1 + (GRID_MM / width) ** 2), STEP_MM, rng.uniform(40, 90, PATCHES), of_echo)
    share = rng.choice([0.0, 0.2], (PAIRS, PATCHES))
    gain = rng.uniform(0.8, 1.0, (PAIRS, PATCHES))
    plane = rng.normal(0, [0.6, 0.01, 0.005], (PAIRS, 3))
    plane[::3, 0] = rng.uniform(0.0, 0.1, len(plane[::3]))
    moved = rng.normal(0, 0.3, (PAIRS, 2))
    z = plane @ np.array([np.ones(PATCHES), LEVERS.lateral_mm, LEVERS.lever_mm])
    d = np.hypot(z, LEVERS.spread_mm * plane[:, 2:])
    rho = gain * (share + (1 - share) / (1 + (d / width[:, 0]) ** 2)) ** 2
    rho = (rho + 0.02 * rng.normal(size=rho.shape)).astype(np.float32)
    used = rng.uniform(size=rho.shape) < 0.9
    used[5] = False
    rho[~used] = np.nan
    return rho, used, moved, EchoModels(share, gain, 0.35), curves, plane


def rules_of(sensed):
    return FitRules(sensed, 5e-4 if sensed else 0.05, 0.05, 2.0, 9.0, 6.0, 0.9, 12)


def fitted(rho, used, moved, models, curves, middle, slopes, either, rules):
    out = FittedPlanes(
        np.full((PAIRS, 3), np.nan), np.zeros((PAIRS, 3, 3)), np.zeros(PAIRS), np.full(rho.shape, np.nan),
        np.full(rho.shape, np.nan),
    )  # fmt: skip
    fit_planes(rho, used, moved, models, LEVERS, curves, middle, slopes, either, rules, out)
    return out


@pytest.mark.parametrize("of_echo", [True, False])
@pytest.mark.parametrize("sensed", [True, False])
def test_planes_are_those_of_one_pair_after_the_other(sensed, of_echo):
    rng = np.random.default_rng(3)
    rho, used, moved, models, curves, truth = scene(rng, of_echo)
    rules, middle = rules_of(sensed), np.maximum(np.abs(truth[:, 0]), 0.15)
    slopes = truth[:, 1:] if sensed else np.zeros((PAIRS, 2))
    either = rng.uniform(size=PAIRS) < 0.5
    got = fitted(rho, used, moved, models, curves, middle, np.ascontiguousarray(slopes), either, rules)
    started = set()
    for e in range(PAIRS):
        some = used[e]
        assert np.array_equal(np.isfinite(got.excess_mm[e]), some)
        assert np.array_equal(np.isfinite(got.sigma_mm[e]), some)
        if not some.any():
            assert np.isnan(got.coefficients[e]).all()
            continue
        lateral, lever = (values[some] - moved[e, k] for k, values in enumerate(LEVERS[:2]))
        starts = [np.array([middle[e], *slopes[e]])]
        if sensed:
            starts += [np.array([-middle[e], *slopes[e]])] * bool(either[e])
        elif middle[e] < rules.widest_slope * np.ptp(lateral) / 2:
            for at in (-0.5, 0.0, 0.5):
                centre = lateral.mean() + at * np.ptp(lateral) / 2
                slope = middle[e] / np.abs(lateral - centre).mean()
                starts.append(np.array([-slope * centre, slope, 0.0]))
        started.add(len(starts))
        share = models.share[e, some]
        echo = share, 1 - share, models.gain[e, some], 1 + 0 * share, 0.35 * share, 0 * share
        precision = [1e-6, rules.slope_sd**-2, rules.slope_sd**-2]
        plane, information, cost, excess, sigma = oracles.correlation_plane(
            rho[e, some].astype(float),
            np.column_stack([np.ones(some.sum()), lateral, lever]),
            LEVERS.spread_mm[some],
            echo,
            curves._replace(amplitude=curves.amplitude[some], cells=curves.cells[some]),
            starts,
            np.array([[0.0, *slopes[e]], precision]),
            2.0,
            9.0,
            6.0,
            -np.inf if sensed else 0.9 * some.sum(),
            12,
        )
        np.testing.assert_allclose(got.coefficients[e], plane, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(got.information[e], information, rtol=1e-6, atol=1e-6 * information.max())
        assert got.cost[e] == pytest.approx(cost, rel=1e-9)
        np.testing.assert_allclose(got.excess_mm[e, some], excess, rtol=1e-5, atol=1e-8)
        np.testing.assert_allclose(got.sigma_mm[e, some], sigma, rtol=1e-5)
    assert started == ({1, 2} if sensed else {1, 4})


def test_a_model_of_one_row_is_that_of_all_pairs():
    rng = np.random.default_rng(5)
    rho, used, moved, models, curves, truth = scene(rng, True)
    middle, either = np.maximum(np.abs(truth[:, 0]), 0.15), np.ones(PAIRS, bool)
    same = [np.ascontiguousarray(field[:1]) for field in models[:2]]
    every = [np.tile(field, (PAIRS, 1)) for field in same]
    slopes, rules = np.zeros((PAIRS, 2)), rules_of(False)
    one, all_rows = (
        fitted(rho, used, moved, EchoModels(*each, 0.35), curves, middle, slopes, either, rules)
        for each in (same, every)
    )
    for a, b in zip(one, all_rows, strict=True):
        np.testing.assert_array_equal(a, b)


def test_subsets_are_those_of_trying_every_plane():
    rng = np.random.default_rng(7)
    at = rng.uniform(-15, 15, (25, 2))
    slopes = rng.normal(0, 0.01, (40, 2))
    z = rng.choice([-1, 1], 40)[:, None] * (rng.uniform(0.1, 0.5, (40, 1)) + slopes @ at.T)
    sigma = rng.uniform(0.02, 0.08, z.shape)
    d = np.abs(z + sigma * rng.normal(size=z.shape)) * rng.choice([1.0, 0.6], z.shape)
    d[rng.uniform(size=z.shape) < 0.1] = np.nan
    d[11] = np.nan
    support = np.ones(z.shape, bool)
    agreeing_patches(d, sigma, slopes @ at.T, np.ones(40, bool), 1.0, support)
    assert not support[11].any()
    for e in range(40):
        expected = oracles.consistent_patches(d[e], sigma[e], at, slopes[e], 1.0)
        assert any(np.array_equal(support[e], each) for each in expected)
