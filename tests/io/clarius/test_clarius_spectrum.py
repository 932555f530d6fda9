"""The band of echoes is found in RF and in I/Q, in noise too, or not at all."""

import numpy as np
import pytest
from scipy.signal import hilbert

from speckle3d.io.clarius.spectrum import band_hz

RATE_HZ = 40e6


def echoes(low_hz, high_hz, snr_db, lines=40, samples=1024, seed=0):
    """Speckle of a raised-cosine band (-6 dB at its edges) that neighbouring lines share, in white noise."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(samples, 1 / RATE_HZ)
    phase = (frequency - (low_hz + high_hz) / 2) / (high_hz - low_hz)
    weight = np.where(np.abs(phase) < 1, np.cos(np.pi / 2 * phase) ** 2, 0)
    white = rng.normal(size=(3, lines + 2, samples))
    common = white[:, :-2] + white[:, 1:-1] + white[:, 2:]
    signal = np.fft.irfft(np.fft.rfft(common) * weight, samples)
    signal *= 300 / signal.std()
    # Electronics of a receiver: constant, and coloured, of its own for each line.
    noise = np.diff(rng.normal(size=(*signal.shape[:2], samples + 1)))
    return signal + 40 + 300 / 10 ** (snr_db / 20) * noise / noise.std()


def as_iq(rf, shift_hz, step=2):
    time_s = np.arange(rf.shape[-1]) / RATE_HZ
    return (hilbert(rf) * np.exp(-2j * np.pi * shift_hz * time_s))[..., ::step].astype(np.complex64)


@pytest.mark.parametrize(("low", "high", "transmit", "snr_db"), [(4.0, 8.0, 7.0, 40), (6.0, 12.0, 10.0, 0)])
def test_band_of_rf_and_of_its_iq(low, high, transmit, snr_db):
    rf, sent_hz = echoes(low * 1e6, high * 1e6, snr_db), transmit * 1e6
    bands = band_hz(rf, RATE_HZ, sent_hz), band_hz(as_iq(rf, sent_hz), RATE_HZ / 2, sent_hz, sent_hz)
    for band in bands:
        # Edges of 54 recordings scatter by 0.05 MHz, and are rounded to 0.1.
        np.testing.assert_allclose(np.array(band) / 1e6, [low, high], atol=0.2)


@pytest.mark.parametrize(
    "band_mhz", [None, (4, 8, -20), (15.5, 18, 40)]
)  # the last: twice the transmit frequency
def test_no_band_is_found_in_nothing_in_noise_or_elsewhere(band_mhz):
    frames = np.zeros((2, 40, 1024))
    if band_mhz is not None:
        frames = echoes(1e6 * band_mhz[0], 1e6 * band_mhz[1], band_mhz[2])
    assert band_hz(frames, RATE_HZ, 7e6) is None
