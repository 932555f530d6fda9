from dataclasses import replace

import numpy as np
import pytest
import speckle
import sweep_examples
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import fft

from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, RFSettings
from speckle3d.matching.intensity import Echo, IntensityExtractor

RF = RFSettings(66.67e6, 1540.0, 7e6, (5e6, 10e6))
GRID = ImageGrid(6, 1800, 0.3, RF.sample_spacing_mm)
BANDS = [(RF, 1800), (sweep_examples.RF, 1001), (RFSettings(37e6, 1540.0, 7e6, (5e6, 10e6)), 1000)]


def extractor(signal, samples):
    return IntensityExtractor(signal, ImageGrid(6, samples, 0.3, signal.sample_spacing_mm))


def step(extractor, signal):
    """Distance of the intensity's samples, in samples of the signal."""
    return extractor.grid.sample_spacing_mm / signal.sample_spacing_mm


def pulse(signal, samples, at):
    """RF of one echo whose envelope's peak is at sample `at`, well inside the band."""
    t = (np.arange(samples) - at) / signal.sampling_rate_hz
    low, high = signal.bandwidth_hz
    envelope = np.exp(-((t * (high - low)) ** 2))
    return np.tile(envelope * np.cos(np.pi * (low + high) * t + 0.7), (6, 1))


def plain_intensity(rf, signal, at):
    """Band-passed analytic signal's intensity `at` some samples, in double precision, far from the wrap."""
    n = 8 * rf.shape[1]
    f = fft.fftfreq(n, 1 / signal.sampling_rate_hz)
    low, high = signal.bandwidth_hz
    edge = 0.1 * (high - low)
    off = np.maximum(low - f, f - high)
    weight = np.where(off <= 0, 1, np.where(off < edge, 0.5 + 0.5 * np.cos(np.pi * off / edge), 0)) * (f > 0)
    band = np.flatnonzero(weight)
    spectrum = 2 * weight[band] * fft.fft(rf.astype(float), n, axis=1)[:, band] / n
    turning = np.exp(2j * np.pi * np.outer(f[band] / signal.sampling_rate_hz, at))
    return np.abs(spectrum @ turning) ** 2


@pytest.mark.parametrize(("signal", "samples"), BANDS)
def test_resampled_intensity_is_the_plain_one_at_its_samples(signal, samples):
    package = extractor(signal, samples)
    rf = np.random.default_rng(0).normal(0, 1000, (6, samples)).astype(np.float32)
    at = step(package, signal) * np.arange(package.grid.samples)
    assert samples - 1 - step(package, signal) < at[-1] <= samples - 1
    expected = plain_intensity(rf, signal, at)
    intensity = package.echo(rf).intensity
    assert intensity.shape == (6, package.grid.samples) == expected.shape
    # The filter's tail, cut where the package pads and the plain one does not, is 1e-4 of the amplitude.
    np.testing.assert_allclose(intensity, expected, rtol=2e-3, atol=1e-3 * expected.mean())


def demodulate(rf, signal, middle_hz, every):
    """I/Q by mixing and a brick-wall filter, in double precision."""
    n = rf.shape[1]
    turns = middle_hz / signal.sampling_rate_hz * np.arange(n)
    spectrum = fft.fft(rf * np.exp(-2j * np.pi * turns), axis=1)
    spectrum[:, np.abs(fft.fftfreq(n)) >= 0.5 / every] = 0
    return 2 * fft.ifft(spectrum, axis=1)[:, ::every]


@pytest.mark.parametrize(("middle_hz", "every"), [(7.5e6, 8), (6.2e6, 6), (4e6, 5)])
def test_i_and_q_give_what_their_rf_gives(middle_hz, every):
    """At the band's middle and off it, down to 6.06 MHz for the 6 of the band and its edges."""
    signal = RFSettings(200e6 / 3, 1540.0, 7.5e6, (5e6, 10e6))
    samples = 1800 - 1800 % every
    rng = np.random.default_rng(3)
    echoes = [rng.normal(0, 1000, (6, 1)) * pulse(signal, samples, at) for at in rng.uniform(250, 1500, 60)]
    rf = sum(echoes)
    baseband = replace(
        signal, sampling_rate_hz=signal.sampling_rate_hz / every, demodulation_frequency_hz=middle_hz
    )
    of_rf, of_iq = extractor(signal, samples), extractor(baseband, samples // every)
    iq = demodulate(rf, signal, middle_hz, every).astype(np.complex64)
    expected, intensity = (e.echo(f).intensity for e, f in ((of_rf, rf.astype(np.float32)), (of_iq, iq)))
    # 4 um at 40 mm: 1e-4 of the rate, of which the echoes' speckle of 0.1 mm sees 1e-3.
    assert abs(of_iq.grid.sample_spacing_mm / of_rf.grid.sample_spacing_mm - 1) < 1e-4
    count = min(expected.shape[1], intensity.shape[1])
    np.testing.assert_allclose(intensity[:, :count], expected[:, :count], atol=3e-3 * expected.max())


@settings(max_examples=50)
@given(
    decibel=st.floats(-59.0, 0.0),
    dynamic_range=st.sampled_from([60.0, 72.5]),
    full=st.sampled_from([255.0, 250.0, 1.0]),
)
def test_log_compression_is_undone(decibel, dynamic_range, full):
    bmode = IntensityExtractor(BModeSettings(dynamic_range, full), ImageGrid(2, 3, 0.1, 0.1))
    grey = full * (1 + decibel / dynamic_range)
    intensity = bmode.echo(np.full((2, 3), grey)).intensity
    np.testing.assert_allclose(intensity, 10 ** (decibel / 10), rtol=1e-4)  # float32 of a 60 dB range


# ---- equalising ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_views():
    rng = np.random.default_rng(5)
    field, independent = speckle.Speckle(rng).image(), speckle.Speckle(rng).image()
    return speckle.intensity(field), speckle.intensity(speckle.mix(field, independent, 0.4))


@pytest.fixture(scope="module")
def ramp():
    """40 dB over depth and a factor of three across."""
    g = speckle.GRID
    x, y = np.linspace(0, 1, g.vectors), np.linspace(0, 1, g.samples)
    return np.asarray(np.outer(3.0**x, 10 ** (-4 * y)), dtype=np.float32)


@pytest.fixture(scope="module")
def equaliser():
    return IntensityExtractor(BModeSettings(60.0), speckle.GRID)


def test_equalising_leaves_the_correlation_of_speckle_and_takes_away_that_of_brightness(
    two_views, ramp, equaliser
):
    ramps = [view * ramp for view in two_views]
    levels = [equaliser.equalised(Echo(view, None), view >= 0.0)[0] for view in ramps]
    plain, steep, level = (np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in (two_views, ramps, levels))
    assert abs(level - plain) < 0.04
    assert steep > plain + 0.1
