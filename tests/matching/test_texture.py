"""Speckle of a known size and spectrum is found to have them."""

from dataclasses import replace

import numpy as np
import pytest
import speckle

from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep
from speckle3d.examine.curves import doubt_sign
from speckle3d.examine.images import doubt_band, standing_share
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.texture import measured_texture

GREY = BModeSettings(dynamic_range_db=100.0, full_scale=65535.0)
"""Fine enough to hold intensities as they are."""


def grey_sweep(frames):
    """Frames of echo intensity as grey levels."""
    decibel = 10 * np.log10(np.maximum(frames / frames.max(), 1e-9))
    grey = np.clip((decibel / GREY.dynamic_range_db + 1) * GREY.full_scale, 0, GREY.full_scale)
    return Sweep(grey.astype(np.uint16), speckle.GRID, GREY, np.arange(len(frames)) / 25)


def texture_of(sweep):
    return measured_texture(sweep, FrameMatcher(sweep))


@pytest.fixture(scope="module")
def images():
    rng = np.random.default_rng(5)
    return np.stack([speckle.intensity(speckle.Speckle(rng).image()) for _ in range(2)])


def test_speckle_has_the_size_it_was_made_with(images):
    size = texture_of(grey_sweep(images)).speckle_size()
    # Some 16 patches a row; taking each one's own mean away makes speckle 6 % finer, in a phantom as here.
    np.testing.assert_allclose(size.lateral_mm, speckle.LATERAL_MM, rtol=0.13)
    np.testing.assert_allclose(size.axial_mm, speckle.AXIAL_MM, rtol=0.13)


RATE, SAMPLES = 40e6, 2048


def echoes(low_hz, high_hz, complex_too=False, noise=0.0, rate_hz=RATE):
    """Sweep of white echoes between two frequencies, and white noise, with the settings that it claims."""
    rng = np.random.default_rng(3)
    frequency = np.fft.fftfreq(SAMPLES, 1 / RATE)
    spectrum = rng.normal(size=(3, 24, SAMPLES)) + 1j * rng.normal(size=(3, 24, SAMPLES))
    frames = np.fft.ifft(spectrum * ((frequency >= low_hz) & (frequency <= high_hz))) * 1e3
    frames += noise * frames.std() * (rng.normal(size=frames.shape) + 1j * rng.normal(size=frames.shape))
    signal = RFSettings(rate_hz, 1540.0, 6e6, (4e6, 8e6), 0.0 if complex_too else None)
    grid = replace(speckle.GRID, vectors=24, samples=SAMPLES, sample_spacing_mm=signal.sample_spacing_mm)
    data = frames.astype(np.complex64) if complex_too else frames.real.astype(np.float32)
    return Sweep(data, grid, signal, np.arange(3) / 25)


@pytest.mark.parametrize("complex_too", [False, True])
@pytest.mark.parametrize(
    ("low", "high"),
    [(4e6, 8e6), (3e6, 9e6), (0.2e6, 5e6)],
    ids=["as claimed", "wider", "mostly attenuated"],
)
def test_echoes_in_the_band_are_believed(low, high, complex_too):
    assert doubt_band(texture_of(echoes(low, high, complex_too))) is None


@pytest.mark.parametrize("complex_too", [False, True])
def test_echoes_above_the_band_refute_the_sampling_rate(complex_too):
    doubt = doubt_band(texture_of(echoes(4e6, 8e6, complex_too, rate_hz=2 * RATE)))
    assert doubt.refuted
    assert doubt.suspect == "sampling rate or band"


def attenuated_iq(sign, middle_hz):
    """I/Q, demodulated at `middle_hz`, of echoes whose frequency falls from 6.2 to 5.2 MHz; `sign` of Q."""
    rng = np.random.default_rng(4)
    white = rng.normal(size=(3, 32, 1024)) + 1j * rng.normal(size=(3, 32, 1024))
    # A beam is wider than the pitch of its vectors.
    white = sum(np.roll(white, k, axis=1) for k in range(4))
    spread = np.fft.fft(white) * np.exp(-((np.fft.fftfreq(1024, 1 / 8e6) / 1e6) ** 2))
    depth = np.linspace(0, 1, 1024)
    turning = np.exp(2j * np.pi * np.cumsum(6.2e6 - 1e6 * depth - middle_hz) / 8e6)
    frames = np.fft.ifft(spread) * turning
    signal = RFSettings(8e6, 1540.0, 6e6, (4e6, 8e6), middle_hz)
    grid = replace(speckle.GRID, vectors=32, samples=1024, sample_spacing_mm=signal.sample_spacing_mm)
    data = (frames.real + sign * 1j * frames.imag).astype(np.complex64)
    return Sweep(data, grid, signal, np.arange(3) / 25)


@pytest.mark.parametrize("middle_hz", [6e6, 7e6])
def test_the_other_sign_of_q_is_doubted(middle_hz):
    assert doubt_sign(texture_of(attenuated_iq(1, middle_hz))) is None
    doubt = doubt_sign(texture_of(attenuated_iq(-1, middle_hz)))
    assert (doubt.suspect, doubt.refuted) == ("sign of Q", False)


# ---- standing echoes -------------------------------------------------------------------------------------

FRESH = np.random.default_rng(0).standard_normal((5, 36, 900))
"""Five frames of white noise, which the matcher's band-pass makes speckle of."""
PATTERN = np.random.default_rng(1).standard_normal((36, 900))


def share_of(frames):
    signal = speckle.RF
    grid = replace(speckle.GRID, vectors=36, samples=900, sample_spacing_mm=signal.sample_spacing_mm)
    sweep = Sweep(frames.astype(np.float32), grid, signal, np.arange(len(frames)) / 25)
    return standing_share(texture_of(sweep), np.column_stack(np.triu_indices(5, 1)))


@pytest.mark.parametrize("power", [0.0, 0.1, 1.0])
def test_standing_share_is_clutters_share_of_the_power(power):
    flickering = np.array([1.0, 0.3, 2.0, 0.7, 1.5])[:, None, None]
    share = share_of(flickering * (FRESH + np.sqrt(power) * PATTERN))
    assert np.median(share) == pytest.approx(power / (1 + power), abs=0.02)


def test_structure_that_moves_in_the_image_does_not_stand_still():
    """By a few samples from frame to frame, as a hand wanders: a quarter of a wavelength is enough."""
    wandering = np.stack([np.roll(PATTERN, 3 * k, axis=1) for k in range(5)])
    assert np.median(share_of(FRESH + wandering)) < 0.1
