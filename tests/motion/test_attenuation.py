"""Attenuation by the echo's spectrum, with structure and noise in it, and the curves stretched for it."""

from functools import cache

import numpy as np
import pytest

from speckle3d.core.curves import CurveKey, DecorrelationCurves, EchoSpectra, NominalProbe, curve_widths
from speckle3d.core.sweep import RFSettings
from speckle3d.motion.attenuation import UNKNOWN_SIGMA, estimate_attenuation
from speckle3d.motion.diffraction import sheet_spectrum, speckle_correlation

BAND = (5e6, 10e6)
DEPTH = np.arange(3.5, 40.0, 3.0)
FREQUENCY = np.linspace(5e6, 10e6, 21)
DISTANCE = 0.01 * np.arange(251)
LENS = NominalProbe(5.0, 20.0, 10.0, *BAND, 0.5)
CELLS = 4000.0
"""Independent values of a row's power at each frequency: 16 frames of 48 vectors."""


def _power(attenuation, rng=None, exponent=0.0, noise=0.0, band=BAND):
    power = sheet_spectrum(FREQUENCY, band, attenuation, 2.0, DEPTH)
    power = power * (FREQUENCY / 7.5e6) ** -np.broadcast_to(exponent, DEPTH.shape)[:, None]
    power = power / power.mean(axis=1, keepdims=True) + np.broadcast_to(noise, DEPTH.shape)[:, None]
    return power if rng is None else power * rng.gamma(CELLS / FREQUENCY.size, size=power.shape)


@cache
def _curves(attenuation=0.5):
    power = _power(attenuation)
    rho = speckle_correlation(LENS, DEPTH, FREQUENCY, power, DISTANCE)
    key = CurveKey(RFSettings(200e6 / 3, 1540.0, 7.5e6, BAND), 0.3, 3.6, 3.0, 2.0, "echo")
    rho = np.minimum.accumulate(np.clip(rho, 1e-4, 1.0), axis=1)
    return DecorrelationCurves(
        key,
        DEPTH,
        DISTANCE,
        rho,
        np.full(DEPTH.size, 60.0),
        spectrum=EchoSpectra(DEPTH, FREQUENCY, power),
    )


def _estimate(curves, power):
    return estimate_attenuation(curves, EchoSpectra(DEPTH, FREQUENCY, power))


@pytest.mark.parametrize("difference", [-0.3, -0.1, 0.0, 0.1, 0.3])
def test_attenuation_in_spite_of_structure_and_noise(difference):
    curves, errors, claims = _curves(), [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        exponent = np.where(rng.random(DEPTH.size) < 0.5, rng.exponential(0.7, DEPTH.size), 0.0)
        noise = 0.2 * (DEPTH / DEPTH[-1]) ** 4
        estimate = _estimate(curves, _power(0.5 + difference, rng, exponent, noise))
        errors.append(estimate.difference_db_cm_mhz - difference)
        claims.append(estimate.sigma_db_cm_mhz)
    assert np.sqrt(np.mean(np.square(errors))) < 0.02
    assert np.abs(np.divide(errors, claims)).max() < 2.0


@pytest.mark.parametrize("difference", [-0.2, 0.3])
def test_curves_stretch_as_the_beam_widens(difference):
    tissue, phantom = _curves(0.5 + difference), _curves(0.5)
    stretch = _estimate(phantom, _power(0.5 + difference)).applied(phantom)
    half = [curve_widths(DISTANCE, c.correlation) for c in (stretch, tissue, phantom)]
    # Length depends on the mean over depth; one power of wavelength for all depths is off by 2 % at some.
    assert abs((half[0] / half[1]).mean() - 1.0) < 0.012
    assert np.abs(half[0] / half[1] - 1.0).max() < 0.025
    assert np.abs(half[2] / half[1] - 1.0).max() > 0.05
    # Curves that have been stretched belong to the tissue, and are not stretched again.
    assert abs(_estimate(stretch, _power(0.5 + difference)).difference_db_cm_mhz) < 0.01


@pytest.mark.parametrize("shift_hz", [-0.5e6, 0.5e6])
def test_another_transmit_band_is_told_and_not_taken_for_attenuation(shift_hz):
    band = (BAND[0] + shift_hz, BAND[1] + shift_hz)
    estimate = _estimate(_curves(), _power(0.5, np.random.default_rng(1), band=band))
    assert estimate.difference_db_cm_mhz == 0.0
    assert estimate.sigma_db_cm_mhz == UNKNOWN_SIGMA
    assert [doubt.suspect for doubt in estimate.doubts] == [
        "another transmit band or filter than the phantom's"
    ]
