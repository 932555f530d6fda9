import numpy as np
import oracles
import pair_planes
import pytest
import speckle
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.sweep import ImageGrid
from speckle3d.matching.patches import lay_patches
from speckle3d.motion.distances import DistanceEstimator, PatchDistances
from speckle3d.motion.planes import PlaneFitter
from speckle3d.motion.subset import consistent_subset

GRID = ImageGrid(vectors=127, samples=640, vector_pitch_mm=0.3, sample_spacing_mm=0.06)
PATCHES = lay_patches(GRID)
AT = PATCHES.centre_mm - GRID.centre_mm[:2]
SIGMA_MM, CELLS = 0.45, 50.0


@pytest.fixture(scope="module")
def estimator():
    return DistanceEstimator(speckle.curves(sigma_mm=SIGMA_MM, cells=CELLS, largest_mm=1.5), PATCHES)


def on_plane(plane):
    return plane[0] + AT @ plane[1:]


def measured(estimator, distance_mm):
    return PatchDistances(np.asarray(distance_mm), estimator.sigma(distance_mm))


def agreeing(distances, raised_mm, support_sigma=1.0, either_side=True):
    """Consistent subset of one pair."""
    alone = PatchDistances(distances.distance_mm[None], distances.sigma_mm[None])
    return consistent_subset(alone, raised_mm[None], support_sigma, np.array([either_side]))[0]


def read(estimator, z_mm, rng):
    """Distances as images give them: from noisy correlations."""
    rho = speckle.gaussian_correlation(np.abs(z_mm), SIGMA_MM)
    return estimator.distances(rho + (1 - rho**2) / np.sqrt(CELLS) * rng.normal(size=rho.size))


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), patches=st.integers(1, 25), support=st.floats(0.3, 2.0))
def test_subset_is_that_of_trying_every_plane(seed, patches, support):
    rng = np.random.default_rng(seed)
    at = rng.uniform(-15, 15, (patches, 2))
    slopes = rng.normal(0, 0.01, 2)
    z = rng.choice([-1, 1]) * (rng.uniform(0.1, 0.5) + at @ slopes)
    sigma = rng.uniform(0.02, 0.08, patches)
    d = np.abs(z + sigma * rng.normal(size=patches)) * rng.choice([1.0, 0.6], patches)
    d[rng.uniform(size=patches) < 0.1] = np.nan
    got = agreeing(PatchDistances(d, sigma), at @ slopes, support)
    expected = oracles.consistent_patches(d, sigma, at, slopes, support)
    assert any(np.array_equal(got, each) for each in expected)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("tilt", [-0.006, 0.0, 0.006])
def test_patches_that_under_read_are_left_out_where_the_orientation_gives_them_away(estimator, side, tilt):
    """Housden et al. 2008, figure 4: rows at the bottom decorrelate too slowly and tip the free plane."""
    rng = np.random.default_rng(6)
    bottom = AT[:, 1] > np.quantile(AT[:, 1], 0.65)
    truth = np.array([side * 0.35, 0.002, tilt])
    design = np.column_stack([np.ones(len(AT)), AT])
    kept_good, kept_bad, free_tilt, held_tilt, offsets = [], [], [], [], []
    for _ in range(25):
        d = np.abs(on_plane(truth))
        d = np.abs(d + 0.5 * estimator.sigma(d) * rng.normal(size=d.size))
        d[bottom] *= 0.6
        subset = agreeing(measured(estimator, d), AT @ truth[1:])
        kept_good.append(subset[~bottom].mean())
        kept_bad.append(subset[bottom].mean())
        free, held = (np.linalg.lstsq(design[s], d[s])[0] for s in (slice(None), subset))
        free_tilt.append(side * free[2])
        held_tilt.append(side * held[2])
        offsets.append(held[0])
    # Within one claimed deviation, twice the scatter put in: 95 % less what the placement itself is off by.
    assert np.mean(kept_good) > 0.85
    assert np.mean(kept_bad) < 0.2
    rejected = 1 - (np.mean(kept_good) * 0.65 + np.mean(kept_bad) * 0.35)
    assert 0.25 < rejected < 0.5
    assert abs(np.mean(held_tilt) - tilt) < 0.4 * abs(np.mean(free_tilt) - tilt)
    assert abs(np.mean(offsets) / 0.35 - 1) < 0.05


def test_the_subset_gives_the_plane_that_biased_patches_hide(estimator):
    """The same from correlations to the plane: sideways, where images see a turn without help."""
    rng = np.random.default_rng(8)
    fitter = PlaneFitter(estimator, AT)
    slow = AT[:, 0] > np.quantile(AT[:, 0], 0.65)
    z = np.full(len(AT), 0.35)
    z[slow] *= 0.6
    free, held = [], []
    for _ in range(25):
        rho = speckle.gaussian_correlation(z, SIGMA_MM)
        rho = rho + (1 - rho**2) / np.sqrt(CELLS) * rng.normal(size=rho.size)
        agreed = agreeing(estimator.distances(rho), np.zeros(len(AT)))
        free.append(pair_planes.fit(fitter, rho, np.zeros(2)).coefficients)
        held.append(pair_planes.fit(fitter, rho, np.zeros(2), subset=agreed, slopes=np.zeros(2)).coefficients)
    free, held = np.mean(free, axis=0), np.mean(held, axis=0)
    assert abs(free[0] / 0.35 - 1) > 0.1
    # A third of the slow patches lies within one deviation of the plane by chance.
    assert abs(held[0] / 0.35 - 1) < 0.05
    assert abs(held[1]) < 0.2 * abs(free[1])


@pytest.mark.parametrize(("sigmas", "kept"), [(1.0, 0.68), (2.0, 0.95)])
def test_where_nothing_is_wrong_as_many_are_left_out_as_the_deviations_say(estimator, sigmas, kept):
    rng = np.random.default_rng(7)
    plane = np.array([0.35, -0.003, 0.008])
    shares = []
    for _ in range(40):
        d = on_plane(plane)
        d = np.abs(d + estimator.sigma(d) * rng.normal(size=d.size))
        distances = PatchDistances(d, estimator.sigma(on_plane(plane)))
        shares.append(agreeing(distances, AT @ plane[1:], sigmas).mean())
    # The best-supported placement keeps a few more than the true one would.
    assert kept - 0.03 < np.mean(shares) < kept + 0.08


@pytest.mark.parametrize("truth", [(0.05, 0.0, 0.02), (0.1, 0.002, -0.02), (-0.1, 0.03, 0.01)])
def test_frames_that_cross_are_placed_on_both_sides(truth):
    """The sensed orientation tells on which side each patch lies; without it the plane would be folded."""
    truth = np.array(truth)
    z = on_plane(truth)
    assert 0.1 < (z < 0).mean() < 0.9
    subset = agreeing(PatchDistances(np.abs(z), np.full(z.size, 0.02)), AT @ truth[1:])
    assert subset.all()


def test_a_side_that_is_settled_is_held():
    truth = np.array([-0.1, 0.03, 0.01])
    distances = PatchDistances(np.abs(on_plane(truth)), np.full(len(AT), 0.02))
    held = agreeing(distances, AT @ truth[1:], either_side=False)
    # Placed through +d alone, the plane still finds its supporters beyond the crossing, none before it.
    assert held.mean() > 0.3
    wrong = agreeing(distances, -AT @ truth[1:], either_side=False)
    either = agreeing(distances, -AT @ truth[1:])
    np.testing.assert_array_equal(either, np.ones(len(AT), bool))
    assert wrong.sum() <= either.sum()


def test_nothing_known_is_nothing_consistent():
    nothing = np.full(len(AT), np.nan)
    assert not agreeing(PatchDistances(nothing, nothing), np.zeros(len(AT))).any()
