import numpy as np
import oracles
from hypothesis import given, settings
from hypothesis import strategies as st
from patch_kernels import patch_coherences, patch_correlations

SHAPE, SIZE = (14, 30), np.array([5, 8])
CROSS = ([0, 1, 1, 1, 2], [1, 0, 1, 2, 1])
"""Of three by three lags those that the kernels fill."""
patches = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 22)), min_size=1, max_size=4)
lags = st.tuples(st.integers(-17, 17), st.integers(-33, 33))


def echoes(seed):
    """Two frames of complex Gaussian echoes, half of them in common."""
    first, second, common = (
        re + 1j * im for re, im in np.random.default_rng(seed).normal(size=(3, 2, *SHAPE))
    )
    return first + common, second + common


def parts(echo):
    return np.stack([echo.real, echo.imag]).astype(np.float32)


def correlate(fixed, moving, first, shift, least_overlap=0.6):
    out = np.empty((len(first), 5))
    images = fixed.astype(np.float32), moving.astype(np.float32)
    patch_correlations(*images, np.array(first), SIZE, np.array(shift), least_overlap, out)
    return out


def cohere(fixed, moving, first, shift, ramp=(0.0, 0.0), least_overlap=0.6):
    out = np.empty((len(first), 5))
    place = np.array(first), SIZE, np.array(shift), np.array(ramp)
    patch_coherences(parts(fixed), parts(moving), *place, least_overlap, out)
    return out


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    first=patches,
    data=st.data(),
    ramp=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.3, 0.3)),
    least_overlap=st.sampled_from([0.2, 0.6, 1.0]),
)
def test_they_are_numpys_of_what_overlaps_at_every_lag(seed, first, data, ramp, least_overlap):
    shift = data.draw(st.lists(lags, min_size=len(first), max_size=len(first)))
    fixed, moving = echoes(seed)
    place = first, SIZE, shift
    # Sums in float32 are right to 1e-7 of the energy.
    a, b = np.abs(fixed) ** 2, np.abs(moving) ** 2
    expected = oracles.of_patches(a, b, *place, least_overlap, oracles.pearson)[:, *CROSS]
    np.testing.assert_allclose(correlate(a, b, first, shift, least_overlap), expected, atol=5e-6)
    expected = oracles.of_patches(fixed, moving, *place, least_overlap, oracles.coherence(ramp))[:, *CROSS]
    np.testing.assert_allclose(cohere(fixed, moving, first, shift, ramp, least_overlap), expected, atol=5e-6)


def test_flat_patches_have_no_correlation_nor_empty_ones_coherence():
    field, _ = echoes(2)
    assert np.isnan(correlate(np.full(SHAPE, 1e5), np.abs(field), [(4, 10)], [(0, 0)])).all()
    assert np.isnan(cohere(field, 0 * field, [(4, 10)], [(0, 0)])).all()
