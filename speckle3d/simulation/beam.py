"""The two-way beam of a linear array with an elevational lens, by diffraction."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from speckle3d.core.arrays import Complex64Array, ComplexArray, FloatArray, IntArray
from speckle3d.core.sweep import RFSettings
from speckle3d.kernels.diffraction import lens_fields
from speckle3d.kernels.scatter import FieldTable, field_table

_NEPER_PER_DB = np.log(10.0) / 20.0

_DEPTH_MM = np.arange(1.0, 45.0 + 1e-9, 0.5)
_ELEVATION_MM = np.arange(0.0, 4.0 + 1e-9, 0.08)
_LATERAL_REACH_MM = 2.7
"""Where the beam is tabulated."""

_PER_PITCH = 4
"""Lateral steps of the table in a pitch of the elements."""

_STRIPS = 64
"""Elevational strips of the aperture, 0.08 mm high: two fifths of the shortest wavelength."""

_NODES_HZ = np.linspace(3e6, 12e6, 13)
_COMPONENTS = 4
"""Frequencies at which the field is computed, and the main components over them that are kept.

They are what makes a short sum broadband.
"""

_FLOOR = 0.01
"""Of each depth's peak: smaller fields are left out."""

_SIGNAL = RFSettings(200e6 / 3, 1540.0, 7.5e6, (5e6, 10e6))


@dataclass(frozen=True)
class Probe:
    """A 5-10 MHz linear array like the papers': 127 vectors at 0.3 mm, focused at 20 mm, 40 mm deep.

    Every vector uses the same full aperture, also at the array's ends. Elements have no kerf.

    Parameters
    ----------
    pitch_mm : float
        Distance of elements, and of vectors.
    transmit_elements : int
        Odd, so that a vector starts from an element's centre. 33 elements are F/2 at 20 mm.
    transmit_focus_mm : float
    receive_f_number, receive_elements : float
        The dynamic receive aperture grows with depth at this F-number up to this many elements.
    edge_weight : float
        Raised-cosine apodisation's weight at the aperture's ends, both ways.
    elevation_aperture_mm, elevation_focus_mm : float
        Height of the elements, and where the lens focuses.
    signal : RFSettings
        Sampling of the vectors.
    """

    pitch_mm: float = 0.3
    transmit_elements: int = 33
    transmit_focus_mm: float = 20.0
    receive_f_number: float = 2.0
    receive_elements: float = 48.0
    edge_weight: float = 0.08
    elevation_aperture_mm: float = 5.0
    elevation_focus_mm: float = 20.0
    signal: RFSettings = _SIGNAL

    def spectrum(self, frequency_hz: FloatArray) -> FloatArray:
        """Two-way pulse spectrum: a raised cosine, halved in amplitude (-6 dB) at the band's edges."""
        low, high = self.signal.bandwidth_hz
        phase = (frequency_hz - (low + high) / 2.0) / (high - low)
        return np.where(np.abs(phase) < 1.0, np.cos(np.pi / 2.0 * phase) ** 2, 0.0)


@dataclass(frozen=True)
class BeamTable:
    """Two-way complex field relative to a delay model, ready for interpolation.

    The field at depth y, lateral x, elevation z and node frequency f is
    ``residual @ components * exp(-4 pi i f (y + kx x^2 + kz z^2) / c)``: the delay carries the fast phase, so
    that the residual is smooth enough for linear interpolation.

    Parameters
    ----------
    residual : ndarray, shape (depth, lateral, elevation, component)
        For x >= 0 and z >= 0; the beam is symmetric in both.
    components : ndarray, shape (component, node)
        How each component is spread over frequency.
    reach : ndarray, shape (depth, lateral)
        Elevational steps to where the amplitude has fallen to the floor for good.
    curvature_per_mm : ndarray, shape (depth, 2)
        kx and kz.
    """

    probe: Probe
    lateral_mm: FloatArray
    residual: Complex64Array
    components: ComplexArray
    reach: IntArray
    curvature_per_mm: FloatArray

    depth_mm = _DEPTH_MM

    @cached_property
    def field(self) -> FieldTable:
        """The beam as `speckle3d.kernels.scatter` reads it."""
        steps = np.array([_DEPTH_MM[0], np.ptp(_DEPTH_MM[:2]), self.lateral_mm[1], _ELEVATION_MM[1]])
        return field_table(self.residual, self.reach, self.curvature_per_mm, steps, _PER_PITCH)

    @property
    def extent_mm(self) -> tuple[float, float]:
        """Largest distances from a vector, lateral and elevational, at which the field is above the floor."""
        lateral = self.lateral_mm[np.flatnonzero(self.reach.any(axis=0))[-1]]
        return float(lateral), float(self.reach.max() * _ELEVATION_MM[1])

    def spectra(self, frequency_hz: FloatArray) -> ComplexArray:
        """Two-way pulse spectrum of each component, shape (component, frequency)."""
        rows = np.stack([np.interp(frequency_hz, _NODES_HZ, row) for row in self.components])
        return np.asarray(rows * self.probe.spectrum(frequency_hz))

    def echo_power(self, frequency_hz: FloatArray) -> FloatArray:
        """Mean square RF at each depth from unit strength at one scatterer per mm^3.

        ``frequency_hz`` are evenly spaced and cover the band. An echo's discrete spectrum at positive
        frequencies is the pulse's, as `speckle3d.simulation.scan` makes it.
        """
        spectra = self.spectra(frequency_hz)
        df = frequency_hz[1] - frequency_hz[0]
        gram = 2.0 * spectra @ spectra.conj().T * df / self.probe.signal.sampling_rate_hz
        field = self.residual * (np.arange(_ELEVATION_MM.size) < self.reach[:, :, None])[..., None]
        # Both mirror halves count, the axis once.
        sides = np.outer(*(np.where(at > 0.0, 2.0, 1.0) for at in (self.lateral_mm, _ELEVATION_MM)))
        cell_mm2 = self.lateral_mm[1] * _ELEVATION_MM[1]
        power = np.einsum("yxzk,kl,yxzl,xz->y", field, gram, field.conj(), sides, optimize=True).real
        return np.asarray(power * cell_mm2 * self.probe.signal.sample_spacing_mm)


@lru_cache(maxsize=4)
def tabulate_beam(probe: Probe = Probe(), attenuation_db_cm_mhz: float = 0.0) -> BeamTable:
    """Compute the two-way field of `probe` by Rayleigh-Sommerfeld sums over elements and lens strips.

    The last four tables, 5 MB each, are kept: the two sweeps of a pair share one, each kind of medium has
    its own.

    Parameters
    ----------
    probe : Probe, optional
    attenuation_db_cm_mhz : float
        One-way attenuation of the medium, proportional to frequency.

    References
    ----------
    .. [1] J. W. Goodman, "Introduction to Fourier Optics", first Rayleigh-Sommerfeld solution.
    """
    step = probe.pitch_mm / _PER_PITCH
    lateral = step * np.arange(0.0, round(_LATERAL_REACH_MM / step) + 1)
    wavenumbers = 2e-3 * np.pi * _NODES_HZ / probe.signal.speed_of_sound_m_s
    field = _sum_sources(probe, lateral, wavenumbers)
    neper = attenuation_db_cm_mhz * _NEPER_PER_DB * 1e-7 * _NODES_HZ
    field *= np.exp(-2.0 * _DEPTH_MM[:, None] * neper)[:, None, None, :]
    field /= np.abs(field[np.argmin(np.abs(_DEPTH_MM - probe.transmit_focus_mm)), 0, 0]).max()
    # Curvature of the two-way wavefront near the axis, lateral and elevational.
    node = _NODES_HZ.size // 2
    middle, double = field[..., node], 2.0 * wavenumbers[node]
    kx = [_parabola(row, lateral, double) for row in middle[:, :, 0]]
    kz = [_parabola(row, _ELEVATION_MM, double) for row in middle[:, 0, :]]
    depth, bend_x, bend_z = np.stack([_DEPTH_MM, kx, kz])[:, :, None, None]
    echo = depth + bend_x * lateral[:, None] ** 2 + bend_z * _ELEVATION_MM**2
    reach = _reach(np.abs(field).max(axis=-1))
    field *= np.exp(2j * echo[..., None] * wavenumbers)
    residual, components = _compress(field, probe.spectrum(_NODES_HZ))
    return BeamTable(probe, lateral, residual, components, reach, np.stack([kx, kz], axis=1))


def _sum_sources(probe: Probe, lateral: FloatArray, wavenumbers: FloatArray) -> ComplexArray:
    """Two-way field, shape (depth, lateral, elevation, node)."""
    widest = int(max(probe.transmit_elements, probe.receive_elements)) | 1
    across = np.repeat((np.arange(widest) - widest // 2) * probe.pitch_mm, _PER_PITCH)
    sent_mm, most_mm = probe.transmit_elements * probe.pitch_mm, probe.receive_elements * probe.pitch_mm
    still = np.ones(_DEPTH_MM.size)
    transmit = _focused(probe, across, sent_mm * still, probe.transmit_focus_mm * still, wavenumbers)
    # The dynamic receive aperture has at least four elements.
    width = np.clip(_DEPTH_MM / probe.receive_f_number, 4 * probe.pitch_mm, most_mm)
    receive = _focused(probe, across, width, _DEPTH_MM, wavenumbers)
    # Sources lie half a step off the lateral grid: from each of its places two are each distance away.
    place, away = np.arange(lateral.size)[:, None], np.arange(lateral.size + across.size // 2)
    sources = place + across.size // 2 + away.size + np.stack([away, -1 - away])[:, None]
    ways = [np.pad(way, ((0, 0), (0, 0), (away.size, away.size))) for way in (transmit, receive)]
    # All elements share the field of one elevational line of strips behind the lens, shifted along the array.
    strip = ((np.arange(_STRIPS) + 0.5) / _STRIPS - 0.5) * probe.elevation_aperture_mm
    lens = probe.elevation_focus_mm - np.hypot(probe.elevation_focus_mm, strip)
    out = np.empty((_DEPTH_MM.size, lateral.size, _ELEVATION_MM.size, wavenumbers.size), dtype=complex)
    line = np.empty((away.size, wavenumbers.size, _ELEVATION_MM.size, 2))
    for iy, depth in enumerate(_DEPTH_MM):
        distance = np.hypot(depth, (away + 0.5) * probe.pitch_mm / _PER_PITCH)
        # Obliquity depth / r and spreading 1 / r of a source in a pressure-release plane.
        lens_fields(distance, _ELEVATION_MM, strip, lens, wavenumbers, 2, 0, away.size, line)
        field = depth * line.view(complex)[..., 0].swapaxes(0, 1)
        transmission, reception = (way[iy][:, sources].sum(axis=1) @ field for way in ways)
        out[iy] = np.moveaxis(transmission * reception, 0, -1)
    return out


def _focused(
    probe: Probe, element: FloatArray, width: FloatArray, focus: FloatArray, wavenumbers: FloatArray
) -> ComplexArray:
    """Weights and focusing phases of the sources, shape (depth, node, source)."""
    across = element / width[:, None]
    cosine = probe.edge_weight + (1.0 - probe.edge_weight) * np.cos(np.pi * across) ** 2
    weight = np.where(np.abs(across) <= 0.5, cosine, 0.0)
    path = focus[:, None] - np.hypot(focus[:, None], element)
    return np.asarray(weight[:, None] * np.exp(-1j * path[:, None] * wavenumbers[:, None]))


def _parabola(profile: ComplexArray, across: FloatArray, wavenumber: float) -> float:
    """Least-squares `a` of path = a x^2 over the main lobe (a third of the axis), by energy."""
    below = np.flatnonzero(np.abs(profile) < np.abs(profile[0]) / 3.0)
    lobe = slice(max(np.append(below, profile.size)[0], 3))
    path = -np.unwrap(np.angle(profile[lobe] * np.conj(profile[0]))) / wavenumber
    weight = np.abs(profile[lobe]) ** 2
    return float((weight * path * across[lobe] ** 2).sum() / (weight * across[lobe] ** 4).sum())


def _compress(field: ComplexArray, pulse: FloatArray) -> tuple[Complex64Array, ComplexArray]:
    """Principal components of the field over frequency, with depths and the pulse's band equally weighted."""
    depth_rms = np.sqrt((np.abs(field) ** 2).mean(axis=(1, 2, 3), keepdims=True))
    weight = np.maximum(pulse, 0.1 * pulse.max())
    field = field * weight
    rows = (field / depth_rms).reshape(-1, pulse.size)
    main = np.linalg.eigh(rows.conj().T @ rows)[1][:, : -_COMPONENTS - 1 : -1]
    return (field @ main).astype(np.complex64), main.conj().T / weight


def _reach(amplitude: FloatArray) -> IntArray:
    """Elevational steps beyond which the field stays below the floor of that depth's peak."""
    nz = amplitude.shape[2]
    above = amplitude > _FLOOR * amplitude.max(axis=(1, 2), keepdims=True)
    reach: IntArray = np.where(above, np.arange(1, nz + 1), 0).max(axis=2).clip(max=nz - 1)
    # A cell between two tabulated depths or laterals must reach as far as the farther of its corners.
    reach[:-1] = np.maximum(reach[:-1], reach[1:])
    reach[:, :-1] = np.maximum(reach[:, :-1], reach[:, 1:])
    return reach
