import numpy as np
import pytest

from speckle3d.io.formats.hdf5_values import demodulation_of

FREQUENCY, RATE = 6e6, 30e6


def echoes(carried_hz, near=1.0, seed=0):
    """Complex noise of a band a third of the frequency about what it carries."""
    rng = np.random.default_rng(seed)
    white = rng.normal(size=(2, 2, 8, 400))
    smooth = np.apply_along_axis(np.convolve, 3, white, np.hanning(25), "same")
    signal = (smooth[0] + 1j * smooth[1]) * np.exp(2j * np.pi * carried_hz / RATE * np.arange(400))
    signal[..., :4] *= near
    return signal.astype(np.complex64)


@pytest.mark.parametrize("attenuation", [1.0, 0.8, 0.65])
@pytest.mark.parametrize("near", [1.0, 1e3])
def test_attenuated_carriers_under_a_strong_near_field(attenuation, near):
    assert demodulation_of(echoes(attenuation * FREQUENCY, near), FREQUENCY, RATE) == 0.0
    assert demodulation_of(echoes((attenuation - 1) * FREQUENCY, near), FREQUENCY, RATE) == FREQUENCY


def test_nothing_is_told_of_noise_of_emptiness_or_of_samples_far_apart():
    rng = np.random.default_rng(1)
    white = (rng.normal(size=(2, 8, 400)) + 1j * rng.normal(size=(2, 8, 400))).astype(np.complex64)
    assert demodulation_of(white, FREQUENCY, RATE) is None
    assert demodulation_of(echoes(0.0), FREQUENCY, 12e6) is None
