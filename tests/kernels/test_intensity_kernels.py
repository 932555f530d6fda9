"""From spectrum to equalised echo, each step against SciPy or NumPy in double precision."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import fft, ndimage

from speckle3d.kernels.intensity import (
    equalise_echo,
    local_mean,
    place_band,
    place_band_of_real,
    squared_magnitude,
)


def in_turn(values):
    return np.ascontiguousarray(values).astype(np.complex64).view(np.float32)


def complex_noise(seed, *shape):
    real, imaginary = np.random.default_rng(seed).normal(size=(2, *shape))
    return real + 1j * imaginary


def test_a_band_goes_to_its_places_and_nothing_elsewhere():
    spectrum, weights = complex_noise(0, 3, 40), np.linspace(0.1, 2.0, 17)
    # Negative frequencies, of the end, first, as of I/Q; the middle to the front.
    bins, places = np.r_[35:40, 0:12], np.r_[14:20, 0:11]
    runs = np.array([[35, 14, 5], [0, 19, 1], [1, 0, 11]])
    got = np.full((3, 20), np.nan + 0j, np.complex64)
    place_band(in_turn(spectrum), in_turn(weights), runs, got.view(np.float32))
    expected = np.zeros((3, 20), complex)
    expected[:, places] = spectrum[:, bins] * weights
    np.testing.assert_allclose(got, expected, rtol=1e-6)


@pytest.mark.parametrize(("first", "count"), [(1, 30), (20, 9), (31, 1)])
def test_a_band_of_real_rows_is_that_of_their_whole_spectrum(first, count):
    rows, bins = np.random.default_rng(1).normal(size=(3, 64)), np.arange(first, first + count)
    weights, turn = np.linspace(0.1, 2.0, count), 1j * np.exp(-2j * np.pi * bins / 64)
    half = count // 2
    runs = np.array([[first, 40 - half, half], [first + half, 0, count - half]])
    got = np.full((3, 40), np.nan + 0j, np.complex64)
    factors = in_turn(weights * (1 - turn) / 2), in_turn(weights * (1 + turn) / 2)
    packed = fft.fft(rows.reshape(3, 32, 2) @ [1, 1j], axis=1)
    place_band_of_real(in_turn(packed), *factors, runs, got.view(np.float32))
    expected = np.zeros((3, 40), complex)
    expected[:, np.r_[40 - half : 40, 0 : count - half]] = fft.rfft(rows, axis=1)[:, bins] * weights
    np.testing.assert_allclose(got, expected, atol=1e-5)


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 40)),
    half=st.tuples(st.integers(0, 6), st.integers(0, 30)),
)
def test_the_local_mean_is_scipys_also_where_the_window_is_larger_than_the_image(seed, shape, half):
    # Five orders of magnitude, as of echoes.
    image = (10 ** np.random.default_rng(seed).uniform(-2, 3, shape)).astype(np.float32)
    got = np.empty_like(image)
    floor = local_mean(image, np.array(half), got)
    expected = ndimage.uniform_filter(image.astype(float), [2 * half[0] + 1, 2 * half[1] + 1], mode="nearest")
    np.testing.assert_allclose(got, expected, rtol=2e-7)
    assert floor == pytest.approx(1e-9 * expected.max(), rel=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_leaves_nothing_to_divide_by(value):
    image = np.ones((5, 12), np.float32)
    image[4, 11] = value
    mean, ratio = np.empty((2, 5, 12), np.float32)
    floor = local_mean(image, np.array([1, 2]), mean)
    assert np.isnan(floor)
    parts = np.empty((2, 5, 12), np.float32)
    equalise_echo(in_turn(np.ones((5, 12))), image, mean, floor, ratio, parts)
    assert np.isnan(ratio).all()
    assert np.isnan(parts).all()


def test_echo_and_intensity_are_divided_by_one_mean():
    echo = 1e3 * complex_noise(2, 6, 50)
    echo[:, 20:40] = 0.0
    intensity, mean, image = np.empty((3, 6, 50), np.float32)
    squared_magnitude(in_turn(echo), intensity)
    np.testing.assert_allclose(intensity, np.abs(echo) ** 2, rtol=1e-6)
    floor = local_mean(intensity, np.array([1, 3]), mean)
    parts = np.empty((2, 6, 50), np.float32)
    equalise_echo(in_turn(echo), intensity, mean, floor, image, parts)
    least = np.maximum(mean.astype(float), floor)
    assert (mean[:, 24:36] < floor).all()
    np.testing.assert_allclose(image, intensity / least, rtol=1e-6)
    np.testing.assert_allclose(parts[0] + 1j * parts[1], echo / np.sqrt(least), rtol=1e-5)


def test_nothing_at_all_stays_nothing():
    nothing, mean, image = np.zeros((3, 4, 9), np.float32)
    parts = np.empty((2, 4, 9), np.float32)
    floor = local_mean(nothing, np.array([1, 1]), mean)
    equalise_echo(np.zeros((4, 18), np.float32), nothing, mean, floor, image, parts)
    assert not image.any()
    assert not parts.any()
