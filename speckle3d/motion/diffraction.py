"""Decorrelation curves from a probe's data sheet, by the two-way broadband field of a lens.

The echo of fully developed speckle, moved by d along the elevational axis, keeps

    rho(d) = |sum_f S(f) gamma_f(d)|^2,   gamma_f(d) = int B_f(z) B_f*(z - d) dz / int |B_f(z)|^2 dz,

where B_f is the two-way field over elevation z at one depth and frequency, the product of the lens's one-way
fields on transmit and on receive, and S the echo's own power spectrum at that depth, which attenuation pulls
down. Off the focus it is the wavefront's curvature in B_f that makes gamma fall.

The field is that of a line source seen along straight paths, without the Fresnel approximation, which fails
in front of a 5 mm aperture at 5 mm. What lies across the image enters through the path alone: elements beside
the axis are farther away, so that the wavefront is less curved near the probe.

References
----------
.. [1] J. W. Goodman, "Introduction to Fourier Optics": field behind a lens.
.. [2] R. F. Wagner et al., "Statistics of speckle in ultrasound B-scans", IEEE Trans. Sonics Ultrason. 30(3),
   1983: the correlation of speckle is the autocorrelation of the point spread function.
"""

import numpy as np
from scipy import fft
from scipy.interpolate import CubicSpline

from speckle3d.core.arrays import ComplexArray, FloatArray
from speckle3d.core.curves import NominalProbe, curve_widths
from speckle3d.core.threads import in_parallel
from speckle3d.kernels.diffraction import lens_fields

FREQUENCIES = 11
"""Nodes over the band; twice as many change distances by less than 0.1 %."""
_STEPS_PER_WAVELENGTH = 4.0
"""Of the shortest wavelength, along the aperture and along the elevation of the field."""
_OFF_AXIS = 0.2
"""Mean square distance of an aperture's elements from its middle over half its width squared: 1/3 for equal
weights, 0.13 for a raised cosine."""
SPEED_M_S = 1540.0
"""Of sound in soft tissue, where no sheet says otherwise."""
BACKSCATTER_EXPONENT = 1.1
"""Of scattered power over frequency in soft tissue, which has 0.6 to 1.6."""


def band_nodes(band_hz: tuple[float, float], edge_fraction: float) -> FloatArray:
    """Frequencies at which the field is computed: the band and its edges, evenly."""
    edge = edge_fraction * (band_hz[1] - band_hz[0])
    return np.linspace(max(band_hz[0] - edge, band_hz[0] / 2.0), band_hz[1] + edge, FREQUENCIES)


def sheet_spectrum(
    frequency_hz: FloatArray,
    band_hz: tuple[float, float],
    attenuation_db_cm_mhz: float,
    backscatter_exponent: float,
    depth_mm: FloatArray,
) -> FloatArray:
    """Power of the echo from depths of any shape, shape (..., f).

    A Gaussian pulse, halved in amplitude there and back (-6 dB) at the band's ends, as a data sheet has it
    for a reflector on the axis. Speckle comes from the whole beam, whose area falls with frequency squared,
    and from scatterers that return more at high frequencies; both ways are attenuated.

    Parameters
    ----------
    frequency_hz : ndarray, shape (f,)
    backscatter_exponent : float
        Of the power that scatterers return, as a function of frequency.
    """
    centre, half = np.mean(band_hz), (band_hz[1] - band_hz[0]) / 2.0
    pulse = 2.0 ** -(((frequency_hz - centre) / half) ** 2)
    scattered = (frequency_hz / centre) ** (backscatter_exponent - 2.0)
    lost_db = 2e-7 * attenuation_db_cm_mhz * depth_mm[..., None] * frequency_hz
    return pulse**2 * scattered * 10.0 ** (-lost_db / 10.0)


def speckle_correlation(
    probe: NominalProbe,
    depth_mm: FloatArray,
    frequency_hz: FloatArray,
    power: FloatArray,
    distance_mm: FloatArray,
    speed_m_s: float = SPEED_M_S,
    at_focus: bool = False,
) -> FloatArray:
    """Correlation of fully developed speckle, the squared magnitude of the echo's, shape (r, k).

    Parameters
    ----------
    depth_mm : ndarray, shape (r,)
    power : ndarray, shape (r, f)
        Of the echo at the frequencies, in any unit.
    distance_mm : ndarray, shape (k,)
    at_focus : bool
        Whether the power is that of scatterers at the lens's focus. Away from it, high frequencies lose what
        they gain there by a narrower beam.
    """
    fields, z = _two_way_fields(probe, np.append(depth_mm, probe.focus_mm), frequency_hz, speed_m_s)
    spectra = np.abs(fft.fft(fields, 2 * z.size, axis=-1)) ** 2
    energy = spectra.mean(axis=-1)
    shares = power / (energy[-1] if at_focus else energy[:-1])
    product = fft.ifft((shares[..., None] * spectra[:-1]).sum(axis=1), axis=-1).real[:, : z.size]
    apart_mm = z - z[0]
    inside = np.minimum(distance_mm, apart_mm[-1])
    return np.asarray(CubicSpline(apart_mm, product / product[:, :1], axis=1)(inside) ** 2)


def tilt_pivot(
    probe: NominalProbe,
    depth_mm: FloatArray,
    frequency_hz: FloatArray,
    power: FloatArray,
    speed_m_s: float,
) -> FloatArray:
    """Pivot about which the speckle of each depth turns when the probe tilts, mm, shape (y,).

    By the distance at which slightly tilted speckle correlates best; see `TiltResponse`.

    Parameters
    ----------
    depth_mm : ndarray, shape (y,)
    power : ndarray, shape (y, f)
    """
    fields, z = _two_way_fields(probe, depth_mm, frequency_hz, speed_m_s)
    two_way = 4e-3 * np.pi * frequency_hz / speed_m_s
    # Of the phase's slope across the beam, its variance, and its covariance with the place.
    slope = fft.ifft(2j * np.pi * fft.fftfreq(z.size, z[1] - z[0]) * fft.fft(fields, axis=-1), axis=-1)
    weight = power / (np.abs(fields) ** 2).sum(axis=-1)
    variance = (weight * (np.abs(slope) ** 2).sum(axis=-1)).sum(axis=1)
    along = (weight * two_way * (z * (fields.conj() * slope).imag).sum(axis=-1)).sum(axis=1)
    return np.asarray(-along / variance)


def _two_way_fields(
    probe: NominalProbe, depth_mm: FloatArray, frequency_hz: FloatArray, speed_m_s: float
) -> tuple[ComplexArray, FloatArray]:
    """Two-way field at each depth and frequency over elevation, shape (y, f, z), and the elevations."""
    wavenumber = 2e-3 * np.pi * frequency_hz / speed_m_s
    shortest = 2.0 * np.pi / wavenumber[-1]
    step = shortest / _STEPS_PER_WAVELENGTH
    count = int(np.ceil(probe.aperture_mm / step))
    strip = probe.aperture_mm * ((np.arange(count) + 0.5) / count - 0.5)
    z: FloatArray = step * np.arange(np.ceil((0.8 * probe.aperture_mm + 1.5) / step) + 1.0)
    delay = probe.focus_mm - np.hypot(probe.focus_mm, strip)
    off_mm = np.sqrt(_OFF_AXIS) * probe.transmit_mm / 2.0
    distance = np.append(depth_mm, np.hypot(depth_mm, off_mm))
    parts = np.empty((distance.size, frequency_hz.size, z.size, 2))
    spread = z, strip, delay, wavenumber, 1
    in_parallel(lambda first, stop: lens_fields(distance, *spread, first, stop, parts), distance.size)
    one_way = parts.view(complex)[..., 0]
    half = one_way[: depth_mm.size] * one_way[-depth_mm.size :]
    return np.concatenate([half[..., :0:-1], half], axis=-1), np.concatenate([-z[:0:-1], z])


def log_width(probe: NominalProbe, depth_mm: FloatArray) -> FloatArray:
    """Logarithm of the curves' widths at each depth, shape (r,); see `curve_widths`."""
    band = probe.low_hz, probe.high_hz
    frequency = band_nodes(band, 0.1)[::2]
    exponents = probe.attenuation_db_cm_mhz, BACKSCATTER_EXPONENT
    power = sheet_spectrum(frequency, band, *exponents, depth_mm)
    distance = np.linspace(0.0, probe.aperture_mm / 2.0, 129)
    rho = speckle_correlation(probe, depth_mm, frequency, power, distance)
    return np.log(curve_widths(distance, np.maximum(rho, 1e-9)))
