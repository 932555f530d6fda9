"""Estimate tissue attenuation relative to the curves' phantom from echo spectra.

Attenuation takes more of an echo the higher its frequency, so that the beam of what is left is wider: curves
of a phantom must be stretched over tissue that attenuates more. With the phantom's power spectrum P at depth
y as reference [1]_, the sweep's is

    S(f) = a P(f) exp(-k f) + noise,   k = 4 beta y + n / f0,

beta being the difference in attenuation per depth and frequency (one way; 4 for power, there and back) and f0
the band's middle. What the scanner does alike in both cancels, and so does gain over depth.

Structure adds n. Scatterers in a line along the elevation send an echo that exceeds speckle's by the beam's
width, as 1/f; those in a plane, as 1/f^2: n lies between 0 and 2 and is never negative. Which depths hold
structure is not known: with a common, unknown probability a row does, and n is then exponentially
distributed; else it is zero. The difference is the mean of its posterior.

References
----------
.. [1] L. X. Yao, J. A. Zagzebski, E. L. Madsen, "Backscatter coefficient measurements using a reference
   phantom to extract depth-dependent instrumentation factors", Ultrasonic Imaging 12, 1990.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.special import log_ndtr, logsumexp

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import ATTENUATION_SIGMA, DecorrelationCurves, EchoSpectra
from speckle3d.core.errors import Doubt
from speckle3d.core.sweep import RFSettings
from speckle3d.motion.lens import stretched

UNKNOWN_SIGMA = 0.1732
"""Standard deviation of the difference where no spectrum tells it: soft tissues and phantoms lie within 0.3
dB/cm/MHz of each other, taken as evenly spread."""
ROW_SIGMA = 0.1
"""Error of a row's exponent beside its fit's: rows of simulated phantoms of 8 mm."""
STRUCTURE_EXPONENT = 0.5
"""Mean of n in rows with structure: a line's, 1, times half of the power. 0.3 to 1 move the difference by at
most 0.01 on average over fourteen sweeps of tissue."""
NOISE_WEIGHT = 0.03
"""Power over the largest at which a frequency has half its weight, -15 dB: without, one sweep in fifty is
14 % off."""
WIDENING = 1.3
"""Power of the echo's wavelength with which curves widen, mean over depth: 1.22 to 1.32 by diffraction for
the probes of two simulators, 1 in front of the focus and 1.5 far behind it."""
OTHER_BAND = 6.0
"""Gain in the log-likelihood by one exponent in all rows, from skin to bottom, from which another transmit
band or filter is told. Twenty-one sweeps of two simulators gain 0.3 to 4.3; with the band 0.3 MHz off they
gain 8.5 to 34."""
_BINS_PER_SAMPLE = 1.5
"""Bins over which a Hann window correlates neighbouring ones."""


@dataclass(frozen=True)
class Attenuation:
    """Attenuation of a sweep's tissue over that of the curves' phantom.

    Attributes
    ----------
    difference_db_cm_mhz, sigma_db_cm_mhz : float
        One way, and its standard deviation; zero and `UNKNOWN_SIGMA` where no spectrum tells.
    depth_mm, log_stretch : ndarray, shape (r,)
        Logarithm of the factor on the curves' distances at each depth.
    doubts : tuple of Doubt
        Of the spectrum.
    """

    difference_db_cm_mhz: float
    sigma_db_cm_mhz: float
    depth_mm: FloatArray
    log_stretch: FloatArray
    doubts: tuple[Doubt, ...] = ()

    @property
    def log_length_sigma(self) -> float:
        """Relative standard deviation of all distances due to the attenuation's."""
        return float(ATTENUATION_SIGMA * self.sigma_db_cm_mhz / UNKNOWN_SIGMA)

    def applied(self, curves: DecorrelationCurves) -> DecorrelationCurves:
        """Phantom curves stretched for the tissue's attenuation, with its spectrum."""
        old = curves.spectrum
        if old is None or not self.log_stretch.any():
            return curves
        power = _attenuate(old.power, old.depth_mm, 1e-6 * old.frequency_hz, self.difference_db_cm_mhz)
        wider = stretched(curves, np.interp(curves.depth_mm, self.depth_mm, self.log_stretch))
        return replace(wider, spectrum=replace(old, power=power))


def estimate_attenuation(curves: DecorrelationCurves, spectra: EchoSpectra | None) -> Attenuation:
    """Compare a sweep's spectrum with that of the curves' phantom.

    Parameters
    ----------
    curves : DecorrelationCurves
    spectra : EchoSpectra or None
        Of the sweep's rows of patches; see `speckle3d.matching.texture`.
    """
    unknown = Attenuation(0.0, UNKNOWN_SIGMA, curves.depth_mm, np.zeros(curves.depth_mm.size))
    signal = curves.key.signal
    if curves.spectrum is None or spectra is None or not isinstance(signal, RFSettings):
        return unknown
    low, high = signal.bandwidth_hz
    inside = (spectra.frequency_hz >= low) & (spectra.frequency_hz <= high)
    # Three numbers are fitted to each row.
    if inside.sum() <= 3:
        return unknown
    frequency_mhz = 1e-6 * spectra.frequency_hz[inside]
    phantom = curves.spectrum.at(spectra.depth_mm, 1e6 * frequency_mhz)
    fall, sigma = _fit_rows(frequency_mhz, spectra.power[:, inside], phantom)
    middle = float(frequency_mhz.mean())
    rows = middle * fall, np.hypot(middle * sigma, ROW_SIGMA), middle * _loss(spectra.depth_mm)
    beta, error, shift, gain = _difference(*rows)
    if gain > OTHER_BAND:
        return replace(unknown, doubts=(_other_band(shift, middle),))
    of_tissue = _attenuate(phantom, spectra.depth_mm, frequency_mhz, beta)
    square = [(power @ frequency_mhz**2) / power.sum(axis=1) for power in (phantom, of_tissue)]
    return Attenuation(beta, error, spectra.depth_mm, WIDENING / 2.0 * np.log(square[0] / square[1]))


def _loss(depth_mm: FloatArray) -> FloatArray:
    """Fall of the logarithm of power per MHz, for 1 dB/cm/MHz, there and back."""
    return np.asarray(0.02 * np.log(10.0) * depth_mm)


def _attenuate(
    power: FloatArray, depth_mm: FloatArray, frequency_mhz: FloatArray, difference: float
) -> FloatArray:
    """Spectrum by depth, with gain that keeps the band's middle."""
    loss = difference * _loss(depth_mm)[:, None] * (frequency_mhz - frequency_mhz.mean())
    return np.asarray(power * np.exp(-loss))


def _fit_rows(
    frequency_mhz: FloatArray, power: FloatArray, reference: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fit power = a reference exp(-k f) + noise at each depth.

    Least squares of logarithms, whose error is the same at each frequency.

    Returns
    -------
    k, sigma : ndarray, shape (r,)
        Per MHz, and its standard deviation.
    """
    f = frequency_mhz - frequency_mhz.mean()
    weight = power / np.maximum(power.max(axis=1, keepdims=True), 1e-30)
    weight = np.sqrt(weight / (weight + NOISE_WEIGHT))
    log_power, log_reference = (
        np.log(np.maximum(v / np.maximum(v.mean(axis=1, keepdims=True), 1e-30), 1e-9))
        for v in (power, reference)
    )
    rows = []
    for row in zip(weight, log_power, log_reference, strict=True):

        def misfit(values: FloatArray, *row: FloatArray) -> FloatArray:
            (gain, fall, log_noise), (weight, log_echo, reference) = values, row
            model = np.logaddexp(reference + gain - fall * f, log_noise)
            return np.asarray(weight * (log_echo - model))

        fit = least_squares(misfit, [0.0, 0.0, row[1].min()], method="lm", args=row)
        jacobian = np.asarray(fit.jac)
        variance = np.linalg.pinv(jacobian.T @ jacobian)[1, 1]
        rows.append((fit.x[1], variance, 2.0 * fit.cost / (f.size - 3)))
    fall, variance, misfits = np.array(rows).T
    misfits = _BINS_PER_SAMPLE * np.maximum(misfits, np.median(misfits))
    return fall, np.sqrt(misfits * variance)


def _difference(
    exponent: FloatArray, sigma: FloatArray, per_unit: FloatArray
) -> tuple[float, float, float, float]:
    """Posterior mean and deviation of the difference in attenuation, dB/cm/MHz.

    And the most likely exponent that all rows have in common, with what it gains in the log-likelihood.

    Parameters
    ----------
    exponent, sigma : ndarray, shape (r,)
        Of frequency, by which the sweep's power falls against the phantom's.
    per_unit : ndarray, shape (r,)
        What 1 dB/cm/MHz adds to it.
    """
    beta, common = np.arange(-1.5, 1.5, 0.01), np.arange(-4.0, 4.1, 0.2)
    left = exponent - beta[:, None] * per_unit - common[:, None, None]
    likelihood = _log_likelihood(left, sigma)
    without = likelihood[common.size // 2]
    weight = np.exp(without - without.max())
    mean = float(np.average(beta, weights=weight))
    deviation = float(np.sqrt(np.average((beta - mean) ** 2, weights=weight)))
    most = int(likelihood.max(axis=1).argmax())
    return mean, deviation, float(common[most]), float(likelihood[most].max() - without.max())


def _log_likelihood(left: FloatArray, sigma: FloatArray) -> FloatArray:
    """Log-likelihood of the rows' residual exponents, shape (..., r) to (...).

    Normal about zero, or about an exponentially distributed exponent of structure; with any share of such
    rows as likely as any other.
    """
    left, steep = left / sigma, sigma / STRUCTURE_EXPONENT
    speckle = -0.5 * left**2 - 0.5 * np.log(2.0 * np.pi)
    structure = np.log(steep) + steep * (0.5 * steep - left) + log_ndtr(left - steep)
    by_share = [
        np.logaddexp(np.log1p(-share) + speckle, np.log(share) + structure).sum(axis=-1)
        for share in np.linspace(0.05, 0.95, 10)
    ]
    return np.asarray(logsumexp(by_share, axis=0))


def _other_band(exponent: float, middle_mhz: float) -> Doubt:
    per_mhz = 10.0 / np.log(10.0) * abs(exponent) / middle_mhz
    return Doubt(
        "curves",
        "another transmit band or filter than the phantom's",
        "expected the phantom's spectrum at the skin, got one that "
        f"{'falls' if exponent > 0 else 'rises'} by {per_mhz:.1f} dB/MHz against it; curves are not adapted "
        "to the tissue's attenuation",
        refuted=False,
    )
