import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from speckle3d.kernels.coherence import NO_GAIN, bin_by_distance, fit_echo_models

from speckle3d.kernels.statistics import PatchCurves

EDGES_MM = np.r_[0.0, 0.1, 0.25, 0.6, 1.0]
STEP_MM, WIDTH_MM = 0.01, 0.5
GRID_MM = np.arange(0, 5.0, STEP_MM)
STRETCHES, LENGTHS_MM = np.array([1.0, 1.4]), np.array([NO_GAIN, 0.0, 5.0])
CELLS = 80.0


def amplitude(d):
    """Heavy-tailed: neither a Gaussian beam's nor an exponential structure's."""
    return 1 / (1 + (d / WIDTH_MM) ** 2)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), pairs=st.integers(0, 60), patches=st.integers(1, 5))
def test_pairs_are_binned_by_the_distance_at_each_patch(seed, pairs, patches):
    rng = np.random.default_rng(seed)
    rho = rng.uniform(0, 1, (pairs, patches)).astype(np.float32)
    rho[rng.random(rho.shape) < 0.2] = np.nan
    offset, slope = rng.uniform(-1.2, 1.2, pairs), rng.uniform(-0.05, 0.05, pairs)
    lateral = rng.uniform(-20, 20, patches)
    out = np.full((patches, EDGES_MM.size - 1, 4), 7.0)
    bin_by_distance(rho, offset, slope, lateral, EDGES_MM, out)
    expected = oracles.bin_by_distance(rho, offset, slope, lateral, EDGES_MM)
    np.testing.assert_allclose(out, expected, rtol=1e-6)  # squares in float32


def exact_bins(distance, rho, each=40.0):
    """Bins of one patch as if every pair lay in the bin's middle and nothing scattered."""
    return np.stack([np.full_like(distance, 1.0), distance, rho, rho**2], axis=1)[None] * each


def fit(bins, scales=(1.0,), stretches=STRETCHES, lengths=LENGTHS_MM, of_echo=True, gain_precision=0.0):
    scales = np.array(scales)
    shape = (len(bins), scales.size, stretches.size, lengths.size)
    cost, found = np.empty(shape), np.empty((*shape, 2))
    table = np.tile(amplitude(GRID_MM), (len(bins), 1))
    curves = PatchCurves(table, STEP_MM, np.full(len(bins), CELLS), of_echo)
    fit_echo_models(bins, scales, stretches, lengths, curves, 20.0, gain_precision, 0, len(bins), cost, found)
    return cost.swapaxes(0, 1), found.swapaxes(0, 1)


DISTANCE_MM = np.linspace(0.05, 2.5, 50)


@pytest.mark.parametrize("of_echo", [True, False])
@pytest.mark.parametrize("c", [0.0, 0.2, 0.5, 0.8])
@pytest.mark.parametrize("gain", [0.6, 0.95])
def test_share_and_gain_of_exact_correlations_are_found(c, gain, of_echo):
    rho = gain * (c * np.exp(-DISTANCE_MM / 5.0) + (1 - c) * amplitude(DISTANCE_MM)) ** 2
    cost, found = fit(exact_bins(DISTANCE_MM, rho), of_echo=of_echo)
    # Steps end below 0.002 and shorten by five each: 0.01 is generous.
    np.testing.assert_allclose(found[0, 0, 0, 2], [c, gain], atol=0.01)
    if c:
        assert cost[0, 0].argmin() == 2


@pytest.mark.parametrize("stretch", [1.0, 1.4])
def test_the_stretch_with_which_it_was_made_costs_least(stretch):
    rho = amplitude(DISTANCE_MM / stretch) ** 2
    cost, found = fit(exact_bins(DISTANCE_MM, rho))
    assert STRETCHES[cost[0, 0, :, 0].argmin()] == stretch
    right = int(stretch > 1)
    np.testing.assert_array_equal(found[0, 0, right, 0], [0.0, 1.0])
    np.testing.assert_allclose(found[0, 0, right, 1], [0.0, 1.0], atol=0.01)


def test_a_stretch_and_a_share_at_once_are_told_apart():
    rho = 0.9 * (0.3 * np.exp(-DISTANCE_MM / 5.0) + 0.7 * amplitude(DISTANCE_MM / 1.4)) ** 2
    cost, found = fit(exact_bins(DISTANCE_MM, rho))
    assert np.unravel_index(cost[0, 0].argmin(), (2, 3)) == (1, 2)
    np.testing.assert_allclose(found[0, 0, 1, 2], [0.3, 0.9], atol=0.01)


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.3])
def test_distances_told_short_or_long_are_scaled_back(scale):
    rho = amplitude(DISTANCE_MM) ** 2
    scales = np.array([0.6, 0.7, 0.85, 1.0, 1.15, 1.3])
    cost, _ = fit(exact_bins(DISTANCE_MM / scale, rho), scales)
    assert scales[cost[:, 0, 0, 0].argmin()] == scale


def test_models_without_structure_have_none_and_without_noise_no_gain():
    rho = 0.8 * (0.4 + 0.6 * amplitude(DISTANCE_MM)) ** 2
    _, found = fit(exact_bins(DISTANCE_MM, rho))
    assert (found[0, 0, :, :2, 0] == 0).all()
    assert (found[0, 0, :, 0, 1] == 1).all()
    assert (found[0, 0, :, 2, 0] > 0.3).all()


def test_the_prior_holds_the_gain_near_one_unless_pairs_are_many():
    rho = 0.7 * amplitude(DISTANCE_MM) ** 2
    few, many = (
        fit(exact_bins(DISTANCE_MM, rho, n), gain_precision=40.0)[1][0, 0, 0, 1, 1] for n in (0.02, 40)
    )
    assert abs(many - 0.7) < 0.01
    assert few > 0.85


def test_scatter_within_bins_adds_to_the_cost_and_not_to_the_share():
    rho = (0.4 * np.exp(-DISTANCE_MM / 5.0) + 0.6 * amplitude(DISTANCE_MM)) ** 2
    bins = exact_bins(DISTANCE_MM, rho)
    wide = bins.copy()
    wide[:, :, 3] += 40.0 * 0.1**2
    (cost, found), (wide_cost, wide_found) = fit(bins), fit(wide)
    assert (wide_cost > cost).all()
    np.testing.assert_allclose(wide_found[0, 0, 0, 2], found[0, 0, 0, 2], atol=1e-6)


def test_patches_are_fitted_each_for_itself_and_empty_bins_passed_over():
    rho = [(c + (1 - c) * amplitude(DISTANCE_MM)) ** 2 for c in (0.1, 0.6)]
    both = np.concatenate([exact_bins(DISTANCE_MM, r) for r in rho])
    both[0, 3::7] = 0.0
    cost, found = fit(both)
    for p in (0, 1):
        kept = both[p][both[p, :, 0] > 0][None]
        alone_cost, alone = fit(kept)
        np.testing.assert_array_equal(cost[0, p], alone_cost[0, 0])
        np.testing.assert_array_equal(found[0, p], alone[0, 0])


@pytest.mark.parametrize("of_echo", [True, False])
def test_every_model_is_fitted_as_by_its_twin(of_echo):
    rng = np.random.default_rng(3)
    patches = 3
    share, gain = rng.uniform(0, 0.9, (2, 2 * patches, 1))
    rho = (0.3 + gain) * (share + (1 - share) * amplitude(DISTANCE_MM)) ** 2
    rho = np.clip(rho + 0.05 * rng.normal(size=rho.shape), 0, 1)
    count = rng.integers(0, 30, rho.shape).astype(float)
    count[1] = 0.0
    bins = np.stack([np.ones_like(rho), np.broadcast_to(DISTANCE_MM, rho.shape), rho, rho**2 + 0.01], axis=-1)
    bins *= count[..., None]
    scales, lengths = np.array([0.4, 1.0, 2.9]), np.array([NO_GAIN, 0.0, 0.004, 4.0, 40.0])
    tables = amplitude(GRID_MM / rng.uniform(0.5, 2.0, (patches, 1)))
    curves = PatchCurves(tables, STEP_MM, rng.uniform(30, 100, patches), of_echo)
    shape = (2 * patches, scales.size, STRETCHES.size, lengths.size)
    cost, found = np.full(shape, np.nan), np.full((*shape, 2), np.nan)
    # In two parts, as threads share them out.
    for part in ((0, 2), (2, 2 * patches)):
        fit_echo_models(bins, scales, STRETCHES, lengths, curves, 20.0, 40.0, *part, cost, found)
    for at in np.ndindex(shape):
        e, s, k, j = at
        of_patch = tables[e % patches], STEP_MM, curves.cells[e % patches], of_echo
        model = scales[s], STRETCHES[k], lengths[j]
        expected = oracles.echo_model(bins[e], *model, of_patch, 20.0, 40.0)
        np.testing.assert_allclose([cost[at], *found[at]], expected, rtol=1e-9, atol=1e-9)
