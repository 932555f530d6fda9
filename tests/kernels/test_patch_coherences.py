import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from patch_kernels import patch_coherences, patch_correlations

SHAPE, SIZE = (14, 30), np.array([5, 8])
# Row sums in float32 are right to 1e-7 of the energy; nothing is subtracted from them.
TOLERANCE = 2e-6


def echoes(seed, shape=SHAPE):
    """Two frames of complex Gaussian echoes, half of them in common."""
    draw = np.random.default_rng(seed).normal(size=(3, 2, *shape))
    own, other, common = (re + 1j * im for re, im in draw)
    return (own + common).astype(np.complex64), (other + common).astype(np.complex64)


def parts(echo):
    return np.stack([echo.real, echo.imag]).astype(np.float32)


def cohere(fixed, moving, first, shift, ramp=(0.0, 0.0), least_overlap=0.6, radius=(1, 1), size=SIZE):
    out = np.empty((len(first), 2 * radius[0] + 1, 2 * radius[1] + 1))
    place = np.array(first), size, np.array(shift), np.array(ramp)
    patch_coherences(parts(fixed), parts(moving), *place, least_overlap, out)
    return out


patches = st.lists(
    st.tuples(st.integers(0, SHAPE[0] - 5), st.integers(0, SHAPE[1] - 8)), min_size=1, max_size=4
)
lags = st.tuples(st.integers(-17, 17), st.integers(-33, 33))


@settings(deadline=None, max_examples=100)
@given(
    seed=st.integers(0, 2**32 - 1),
    first=patches,
    data=st.data(),
    ramp=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.3, 0.3)),
    radius=st.tuples(st.integers(0, 2), st.integers(0, 2)),
    least_overlap=st.sampled_from([0.0, 0.3, 0.6, 1.0]),
)
def test_is_the_squared_coherence_of_what_overlaps_at_every_lag(
    seed, first, data, ramp, radius, least_overlap
):
    shift = data.draw(st.lists(lags, min_size=len(first), max_size=len(first)))
    fixed, moving = echoes(seed)
    got = cohere(fixed, moving, first, shift, ramp, least_overlap, radius)
    expected = oracles.patch_coherences(fixed, moving, first, SIZE, shift, ramp, least_overlap, radius)
    np.testing.assert_allclose(got, expected, atol=TOLERANCE)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), gain=st.floats(1e-6, 1e6), turn_rad=st.floats(-4, 4))
def test_neither_gain_nor_a_common_phase_matters(seed, gain, turn_rad):
    fixed, moving = echoes(seed)
    plain = cohere(fixed, moving, [(4, 10)], [(1, -2)])
    other = cohere(fixed, gain * np.exp(1j * turn_rad) * moving, [(4, 10)], [(1, -2)])
    np.testing.assert_allclose(other, plain, atol=TOLERANCE)


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    ramp=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.3, 0.3)),
    shift=st.tuples(st.integers(-3, 3), st.integers(-5, 5)),
)
def test_a_ramp_in_the_second_frames_phase_is_undone(seed, ramp, shift):
    """Whatever the lag, which only adds a common phase."""
    fixed, moving = echoes(seed)
    v, s = np.indices(SHAPE)
    behind = moving * np.exp(-1j * (ramp[0] * v + ramp[1] * s))
    plain = cohere(fixed, moving, [(4, 10)], [shift])
    np.testing.assert_allclose(cohere(fixed, behind, [(4, 10)], [shift], ramp), plain, atol=TOLERANCE)


def test_the_ramp_turned_the_wrong_way_makes_matters_worse():
    fixed, _ = echoes(3)
    v, s = np.indices(SHAPE)
    behind = fixed * np.exp(-1j * (0.4 * v + 0.1 * s))
    right, none, wrong = (
        cohere(fixed, behind, [(4, 10)], [(0, 0)], ramp)[0, 1, 1]
        for ramp in ((0.4, 0.1), (0.0, 0.0), (-0.4, -0.1))
    )
    assert abs(right - 1) < TOLERANCE
    assert wrong < none < 0.75


@pytest.mark.parametrize("dead", [0, 1])
def test_patches_without_any_echo_have_no_coherence(dead):
    frames = list(echoes(0))
    frames[dead] = np.zeros_like(frames[dead])
    assert np.isnan(cohere(*frames, [(4, 10)], [(0, 0)])).all()


def test_a_lag_that_lands_on_silence_is_empty_and_its_neighbours_are_not():
    fixed, moving = echoes(0)
    moving[:6] = 0.0
    got = cohere(fixed, moving, [(2, 10)], [(0, 0)])[0]
    assert np.isnan(got[0]).all()
    assert np.isfinite(got[1:]).all()


def test_a_shifted_copy_coheres_by_one_at_its_shift_alone():
    fixed, _ = echoes(1, (40, 80))
    moving = np.roll(fixed, (3, -7), axis=(0, 1))
    got = cohere(fixed, moving, [(12, 20)], [(2, -6)], radius=(2, 2), size=np.array([12, 30]))[0]
    assert np.unravel_index(np.argmax(got), got.shape) == (3, 1)
    assert abs(got[3, 1] - 1) < TOLERANCE
    # Of 360 samples of nothing: exponential about 1 / 360; one in e^9 is larger than this, times 24.
    assert np.sort(got.ravel())[-2] < 12 / 360


def test_overlap_is_counted_as_for_intensity():
    fixed, moving = echoes(2)
    # Of five vectors, three stay inside at lags 1..3 when the patch touches the far edge: 60 %.
    for least, finite in ((0.6, True), (0.61, False)):
        first, shift = [(SHAPE[0] - 5, 10)], [(1, 0)]
        got = cohere(fixed, moving, first, shift, least_overlap=least)
        images = ((np.abs(echo) ** 2).astype(np.float32) for echo in (fixed, moving))
        other = np.empty((1, 3, 3))
        patch_correlations(*images, np.array(first), SIZE, np.array(shift), least, other)
        assert (np.isfinite(got) == finite).all()
        assert (np.isfinite(other) == finite).all()


def test_one_call_leaves_nothing_behind_for_the_next_patch():
    fixed, moving = echoes(5)
    places, shifts = [(0, 0), (9, 22), (4, 10)], [(0, 0), (4, 9), (-1, 3)]
    together = cohere(fixed, moving, places, shifts, (0.2, -0.1))
    alone = [cohere(fixed, moving, [at], [by], (0.2, -0.1))[0] for at, by in zip(places, shifts, strict=True)]
    np.testing.assert_array_equal(together, alone)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    first=patches,
    radius=st.tuples(st.integers(0, 2), st.integers(0, 2)),
    of_echo=st.booleans(),
)
def test_without_corners_the_lags_along_either_axis_are_the_same(seed, first, radius, of_echo):
    frames = echoes(seed)
    out = np.full((2, len(first), 2 * radius[0] + 1, 2 * radius[1] + 1), 7.0)
    place = np.array(first), SIZE, np.zeros((len(first), 2), np.int64)
    for corners in (False, True):
        if of_echo:
            kernel_arguments = *(parts(echo) for echo in frames), *place, np.array([0.1, 0.2])
            patch_coherences(*kernel_arguments, 0.3, out[int(corners)], corners)
        else:
            images = ((np.abs(echo) ** 2).astype(np.float32) for echo in frames)
            patch_correlations(*images, *place, 0.3, out[int(corners)], corners)
    cross = np.zeros(out.shape[2:], bool)
    cross[radius[0]], cross[:, radius[1]] = True, True
    np.testing.assert_array_equal(out[0][:, cross], out[1][:, cross])
    assert np.isnan(out[0][:, ~cross]).all()
