"""The band of echoes is found in RF and in I/Q, in noise too, or not at all."""

from dataclasses import replace

import clarius_examples as examples
import numpy as np
import pytest
from clarius_examples import GIVEN, sweep_of
from scipy.signal import hilbert

from speckle3d.io.clarius.spectrum import Echoes
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


@pytest.mark.parametrize("snr_db", [40, 0])
@pytest.mark.parametrize(("low", "high", "transmit"), [(4.0, 8.0, 7.0), (6.0, 12.0, 10.0)])
def test_band_of_rf_and_of_its_iq(low, high, transmit, snr_db):
    rf, sent_hz = echoes(low * 1e6, high * 1e6, snr_db), transmit * 1e6
    for spectrum in (Echoes(rf, RATE_HZ, sent_hz), Echoes(as_iq(rf, sent_hz), RATE_HZ / 2, sent_hz, sent_hz)):
        # Some 4,000 spectra of 0.5 MHz, a window that widens the edges by 0.1, and rounding to 0.1.
        np.testing.assert_allclose(np.array(spectrum.band_hz) / 1e6, [low, high], atol=0.35)


def test_attenuation_lowers_the_centre_and_the_other_sign_of_q_raises_it(tmp_path):
    """Echoes whose band falls by 1 MHz along the lines."""
    parts = (echoes(low, low + 4e6, 30, samples=400) for low in (4.5e6, 4e6, 3.5e6))
    rf = np.concatenate(list(parts), axis=-1)
    np.testing.assert_allclose(np.array(Echoes(rf, RATE_HZ, 6e6).centres_hz) / 1e6, [6.5, 5.5], atol=0.2)
    for iq, near, far in ((as_iq(rf, 6e6), 6.5, 5.5), (as_iq(rf, 6e6).conj(), 5.5, 6.5)):
        centres = Echoes(iq, RATE_HZ / 2, 6e6, 6e6).centres_hz
        np.testing.assert_allclose(np.array(centres) / 1e6, [near, far], atol=0.2)
        sweep = sweep_of("iq", frames=3, vectors=12, samples=iq.shape[-1])
        signal = replace(sweep.signal, sampling_rate_hz=RATE_HZ / 2)
        grid = replace(sweep.grid, sample_spacing_mm=signal.sample_spacing_mm)
        sweep = replace(sweep, frames=np.round(10 * iq[:, :12]), signal=signal, grid=grid)
        package = examples.write_package(tmp_path / f"{near}.tar", sweep)
        assert any("Q has the other sign" in note for note in import_notes(package, GIVEN)) == (far > near)


@pytest.mark.parametrize(
    "frames",
    [
        np.random.default_rng(2).normal(size=(3, 40, 1024)),
        np.random.default_rng(0).normal(size=(3, 1, 1024)),
        np.random.default_rng(0).normal(size=(1, 40, 8)),
        np.zeros((2, 40, 1024)),
        echoes(4e6, 8e6, -20),
        echoes(15.5e6, 18e6, 40),  # twice the transmit frequency and more
    ],
)
def test_no_band_is_found_in_noise_in_nothing_or_elsewhere(frames):
    assert Echoes(frames, RATE_HZ, 7e6).band_hz is None
