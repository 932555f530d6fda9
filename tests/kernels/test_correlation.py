import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from patch_kernels import patch_correlations

SHAPE, SIZE = (14, 30), np.array([5, 8])
# Row sums in float32 are right to 1e-7 of the energy, which is twice the variance of speckle.
TOLERANCE = 2e-6


def speckle(seed, shape=SHAPE):
    """Two images of exponential intensity, partly alike, so that no coefficient is trivially zero."""
    rng = np.random.default_rng(seed)
    own, common = rng.normal(size=(2, 2, *shape)), rng.normal(size=(2, *shape))
    return ((own + common) ** 2).sum(axis=1).astype(np.float32)


def correlate(fixed, moving, first, shift, least_overlap=0.6, radius=(1, 1), size=SIZE):
    out = np.empty((len(first), 2 * radius[0] + 1, 2 * radius[1] + 1))
    patch_correlations(fixed, moving, np.array(first), size, np.array(shift), least_overlap, out)
    return out


patches = st.lists(
    st.tuples(st.integers(0, SHAPE[0] - 5), st.integers(0, SHAPE[1] - 8)), min_size=1, max_size=4
)
lags = st.tuples(st.integers(-17, 17), st.integers(-33, 33))


@settings(deadline=None, max_examples=150)
@given(
    seed=st.integers(0, 2**32 - 1),
    first=patches,
    data=st.data(),
    radius=st.tuples(st.integers(0, 2), st.integers(0, 2)),
    least_overlap=st.sampled_from([0.0, 0.3, 0.6, 1.0]),
)
def test_is_pearsons_coefficient_of_what_overlaps_at_every_lag(seed, first, data, radius, least_overlap):
    shift = data.draw(st.lists(lags, min_size=len(first), max_size=len(first)))
    fixed, moving = speckle(seed)
    got = correlate(fixed, moving, first, shift, least_overlap, radius)
    expected = oracles.patch_correlations(fixed, moving, first, SIZE, shift, least_overlap, radius)
    # Patches cut down to a few samples may by chance be all but constant: 1e-4 covers their conditioning.
    np.testing.assert_allclose(got, expected, atol=TOLERANCE if least_overlap >= 0.6 else 1e-4)


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 2**32 - 1),
    gain=st.floats(1e-6, 1e6),
    shift=st.tuples(st.integers(-4, 4), st.integers(-4, 4)),
)
def test_gain_does_not_matter(seed, gain, shift):
    fixed, moving = speckle(seed)
    plain = correlate(fixed, moving, [(4, 10)], [shift])
    louder = correlate(fixed, np.float32(gain) * moving, [(4, 10)], [shift])
    np.testing.assert_allclose(louder, plain, atol=TOLERANCE)


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 2**32 - 1),
    level=st.sampled_from([0.0, 1.0, 1e-8, 1e8, 0.1]),
    which=st.booleans(),
    shift=st.tuples(st.integers(-4, 4), st.integers(-4, 4)),
)
def test_flat_patches_have_no_correlation(seed, level, which, shift):
    images = [speckle(seed)[0], np.full(SHAPE, level, np.float32)]
    fixed, moving = images[::-1] if which else images
    assert np.isnan(correlate(fixed, moving, [(4, 10)], [shift])).all()


def test_a_lag_that_lands_on_a_flat_strip_is_empty_and_its_neighbours_are_not():
    fixed, moving = speckle(0)
    moving[:6] = 3.0
    got = correlate(fixed, moving, [(2, 10)], [(0, 0)])[0]
    assert np.isnan(got[0]).all()
    assert np.isfinite(got[1:]).all()


def test_a_shifted_copy_correlates_by_one_at_its_shift_alone():
    fixed, _ = speckle(1, (40, 80))
    moving = np.roll(fixed, (3, -7), axis=(0, 1))
    got = correlate(fixed, moving, [(12, 20)], [(2, -6)], radius=(2, 2), size=np.array([12, 30]))[0]
    assert np.unravel_index(np.argmax(got), got.shape) == (3, 1)
    assert abs(got[3, 1] - 1) < TOLERANCE
    # 360 independent samples: five standard deviations of a coefficient of nothing.
    assert np.sort(got.ravel())[-2] < 5 / np.sqrt(360)


def test_overlap_is_counted_at_the_worst_lag_and_shared_by_all():
    fixed, moving = speckle(2)
    # Of five vectors, three stay inside at lags 1..3 when the patch touches the far edge: 60 %.
    first, shift = [(SHAPE[0] - 5, 10)], [(1, 0)]
    assert np.isfinite(correlate(fixed, moving, first, shift, 0.6)).all()
    assert np.isnan(correlate(fixed, moving, first, shift, 0.61)).all()


@settings(deadline=None, max_examples=25)
@given(hnp.arrays(np.float32, SHAPE, elements=st.floats(0, 1000, width=32)))
def test_any_image_correlates_with_itself_by_one_or_not_at_all(image):
    got = correlate(image, image, [(4, 10), (0, 0)], [(0, 0), (2, 2)])
    assert np.isnan(got[0, 1, 1]) or abs(got[0, 1, 1] - 1) < TOLERANCE
    assert (np.isnan(got) | (np.abs(got) <= 1 + 1e-3)).all()
