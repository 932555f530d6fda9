"""I/Q and grey levels of known echoes."""

import numpy as np
import pytest

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import RFSettings, Sweep
from speckle3d.simulation.receiver import received
from speckle3d.simulation.scan import SPECKLE_RMS_COUNTS

RF = RFSettings(200e6 / 3, 1540.0, 7.5e6, (5e6, 10e6))
SAMPLES, INSIDE = 1200, slice(20, -20)
"""Away from what the ends of the filter cut off."""


def rf_sweep(waves):
    frames = np.rint(waves)[None].astype(np.int16)
    grid = ImageGrid(*waves.shape, 0.3, RF.sample_spacing_mm, 3.0)
    return Sweep(frames, grid, RF, np.zeros(1))


def tone(frequency_hz, amplitude=10000.0, phase=0.4):
    t = np.arange(SAMPLES) / RF.sampling_rate_hz
    return rf_sweep(amplitude * np.cos(2 * np.pi * frequency_hz * t + phase)[None])


@pytest.mark.parametrize("middle_hz", [6.5e6, 8.5e6])
@pytest.mark.parametrize("frequency_hz", [4.6e6, 10.4e6])
def test_a_tone_turns_at_what_it_is_off_the_demodulation_with_its_phase_and_no_delay(frequency_hz, middle_hz):
    sweep = received(tone(frequency_hz), None, middle_hz)
    t = np.arange(sweep.grid.samples) / sweep.signal.sampling_rate_hz
    expected = 10000.0 * np.exp(1j * (2 * np.pi * (frequency_hz - middle_hz) * t + 0.4))
    # 80 dB of the filter, and whole counts.
    np.testing.assert_allclose(sweep.frames[0][0, INSIDE], expected[INSIDE], atol=10.0)


@pytest.mark.parametrize("frequency_hz", [1e6, 14.6e6])
def test_what_would_fold_into_the_band_is_filtered_out(frequency_hz):
    sweep = received(tone(frequency_hz), None, 7.5e6)
    # Without the filter these would be where the band is kept.
    rate_hz = sweep.signal.sampling_rate_hz
    assert abs((frequency_hz - 7.5e6 + rate_hz / 2) % rate_hz - rate_hz / 2) < 3e6
    assert np.abs(sweep.frames[0][0, INSIDE]).max() < 10.0


def test_grey_levels_are_the_envelope_in_decibel():
    # The envelope's square over speckle's, whose rms as RF is that of a tone of the root of two times it.
    for decibel in (0.0, -13.0, 15.0):
        amplitude = np.sqrt(2) * SPECKLE_RMS_COUNTS * 10 ** (decibel / 20)
        sweep = received(tone(7.5e6, amplitude), 60.0)
        grey = sweep.frames[0][0, INSIDE].astype(float)
        assert sweep.frames.dtype == np.uint8
        expected = 255 * (1 + (decibel - 20.0) / 60.0)
        # Half a level of rounding, and counts rounded.
        assert np.abs(grey - expected).max() < 0.6
