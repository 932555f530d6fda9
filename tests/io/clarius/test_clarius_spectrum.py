"""The band of echoes is found in RF and in I/Q, in noise too, or not at all."""

from dataclasses import replace

import clarius_examples as examples
import numpy as np
import pytest
from clarius_examples import GIVEN, sweep_of
from scipy.signal import hilbert

from speckle3d.io.clarius.spectrum import measured_band_hz, measured_centres_hz
from speckle3d.io.load import import_notes

RATE_HZ = 40e6


def echoes(low_hz, high_hz, snr_db, lines=40, samples=1024, seed=0):
    """Speckle of a raised-cosine band (-6 dB at its edges) that neighbouring lines share, in white noise."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(samples, 1 / RATE_HZ)
    phase = (frequency - (low_hz + high_hz) / 2) / (high_hz - low_hz)
    weight = np.where(np.abs(phase) < 1, np.cos(np.pi / 2 * phase) ** 2, 0)
    white = rng.normal(size=(3, lines + 2, samples))
    shared = white[:, :-2] + white[:, 1:-1] + white[:, 2:]
    signal = np.fft.irfft(np.fft.rfft(shared) * weight, samples)
    signal *= 300 / signal.std()
    # Electronics of a receiver: constant, and coloured, of its own for each line.
    noise = np.diff(rng.normal(size=(*signal.shape[:2], samples + 1)))
    return signal + 40 + 300 / 10 ** (snr_db / 20) * noise / noise.std()


def as_iq(rf, shift_hz, step=2):
    time_s = np.arange(rf.shape[-1]) / RATE_HZ
    return (hilbert(rf) * np.exp(-2j * np.pi * shift_hz * time_s))[..., ::step].astype(np.complex64)


@pytest.mark.parametrize("snr_db", [40, 10, 0])
@pytest.mark.parametrize(("low", "high", "transmit"), [(4.0, 8.0, 7.0), (6.0, 12.0, 10.0)])
def test_band_of_rf_and_of_its_iq(low, high, transmit, snr_db):
    rf = echoes(low * 1e6, high * 1e6, snr_db)
    by_rf = measured_band_hz(rf, RATE_HZ, transmit * 1e6, None)
    by_iq = measured_band_hz(as_iq(rf, transmit * 1e6), RATE_HZ / 2, transmit * 1e6, transmit * 1e6)
    for found in (by_rf, by_iq):
        # Some 4,000 spectra of 0.5 MHz, a window that widens the edges by 0.1, and rounding to 0.1.
        np.testing.assert_allclose(np.array(found) / 1e6, [low, high], atol=0.35)


def attenuated():
    """Echoes whose band falls by 1 MHz along the lines."""
    near, middle, far = (echoes(low, low + 4e6, 30, samples=400) for low in (4.5e6, 4e6, 3.5e6))
    return np.concatenate([near, middle, far], axis=-1)


def test_attenuation_lowers_the_centre_and_the_other_sign_of_q_raises_it():
    rf = attenuated()
    iq = as_iq(rf, 6e6)
    by_rf = measured_centres_hz(rf, RATE_HZ, 6e6, None)
    by_iq = measured_centres_hz(iq, RATE_HZ / 2, 6e6, 6e6)
    np.testing.assert_allclose(np.array([by_rf, by_iq]) / 1e6, [[6.5, 5.5]] * 2, atol=0.2)
    mirrored = measured_centres_hz(iq.conj(), RATE_HZ / 2, 6e6, 6e6)
    np.testing.assert_allclose(np.array(mirrored) / 1e6, [5.5, 6.5], atol=0.2)


def test_a_package_with_the_other_sign_of_q_is_noted(tmp_path):
    rf = attenuated()[:, :12]
    for iq, odd in ((as_iq(rf, 6e6), False), (as_iq(rf, 6e6).conj(), True)):
        sweep = sweep_of("iq", frames=3, vectors=12, samples=iq.shape[-1])
        signal = replace(sweep.signal, sampling_rate_hz=RATE_HZ / 2)
        grid = replace(sweep.grid, sample_spacing_mm=signal.sample_spacing_mm)
        sweep = replace(sweep, frames=np.round(10 * iq), signal=signal, grid=grid)
        package = examples.write_package(tmp_path / f"{odd}.tar", sweep)
        assert any("Q has the other sign" in each for each in import_notes(package, GIVEN)) == odd


def test_noise_has_no_band():
    rng = np.random.default_rng(2)
    assert measured_band_hz(rng.normal(size=(3, 40, 1024)), RATE_HZ, 7e6, None) is None
    assert measured_band_hz(echoes(4e6, 8e6, -20), RATE_HZ, 7e6, None) is None


@pytest.mark.parametrize("shape", [(1, 2, 64), (1, 40, 16), (3, 1, 1024), (1, 40, 8)])
def test_too_few_samples_tell_nothing(shape):
    assert measured_band_hz(np.random.default_rng(0).normal(size=shape), RATE_HZ, 7e6, None) is None


def test_echoes_of_nothing_tell_nothing():
    assert measured_band_hz(np.zeros((2, 40, 1024)), RATE_HZ, 7e6, None) is None


def test_a_band_elsewhere_than_the_transmit_frequency_is_not_taken():
    assert measured_band_hz(echoes(12e6, 16e6, 40), RATE_HZ, 4e6, None) is None
