"""Frames of RF from a beam, a medium and poses; computed when read, the same each time."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.fft import fft, irfft, next_fast_len
from scipy.spatial.transform import RigidTransform

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import FloatArray
from speckle3d.core.sweep import ImageGrid
from speckle3d.kernels.scatter import scatter_echoes
from speckle3d.simulation.beam import BeamTable, Complex64Array
from speckle3d.simulation.medium import Medium, Scatterers

FULL_SCALE = 8191
"""14 bits, signed."""

SPECKLE_RMS_COUNTS = 350.0
"""Fully developed speckle of unit strength after time-gain compensation: 27 dB below full scale."""

_GUARD_SAMPLES = 160
"""Longer than the pulse (its raised-cosine spectrum is 10 MHz wide): keeps the FFT's ends apart."""


@dataclass(frozen=True)
class Receiver:
    """From echoes to counts: fixed time-gain compensation for a uniform medium, and electronic noise.

    Parameters
    ----------
    snr_db : float
        Unit-strength speckle over electronic noise at the transmit focus.
    noise_band_hz : tuple of float
        The amplifier's pass band.
    max_gain_db : float
        Most that time-gain compensation amplifies over its value at the focus.
    """

    snr_db: float = 40.0
    noise_band_hz: tuple[float, float] = (2e6, 13e6)
    max_gain_db: float = 40.0


@dataclass(frozen=True)
class SimulatedFrames:
    """RF frames of one sweep; a frame is computed when it is indexed, so a sweep of any length fits.

    Parameters
    ----------
    beam : BeamTable
    medium : Medium
    medium_from_image : RigidTransform, length n
    image : ImageGrid
    receiver : Receiver
    noise_entropy : int
        With a frame's index, the seed of its electronic noise.
    """

    beam: BeamTable
    medium: Medium
    medium_from_image: RigidTransform
    image: ImageGrid
    receiver: Receiver = field(default_factory=Receiver)
    noise_entropy: int = 0

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, vectors, samples."""
        return len(self.medium_from_image), self.image.vectors, self.image.samples

    @property
    def dtype(self) -> np.dtype[Any]:
        """Counts."""
        return np.dtype(np.int16)

    def __len__(self) -> int:
        return len(self.medium_from_image)

    def __getitem__(self, index: int) -> npt.NDArray[np.int16]:
        """One frame, shape (vector, sample), 14-bit counts."""
        n = len(self)
        if not -n <= index < n:
            raise IndexError(f"frame {index} of {n}")
        index %= n
        counts = self._spectra.waveforms(self.echoes(index), self._noise(index)) * self._gain
        return np.clip(np.rint(counts), -FULL_SCALE, FULL_SCALE).astype(np.int16)

    def echoes(self, index: int) -> Complex64Array:
        """Baseband echoes of frame `index` at every frequency node, shape (vector, sample, node)."""
        blocks = self._near(self.medium_from_image[index])
        position = np.concatenate([p for p, _ in blocks])
        strength = np.concatenate([s for _, s in blocks])
        out = np.zeros((self.image.vectors, self._spectra.length, self.beam.node_hz.size), np.complex64)
        probe, image = self.beam.probe, self.image
        vector_mm = np.arange(image.vectors) * image.vector_pitch_mm
        order, start, first, last = _by_lateral_cell(position, vector_mm, self.beam.lateral_extent_mm)
        scatter_echoes(
            position[order],
            strength[order],
            start,
            first,
            last,
            vector_mm,
            self.beam.residual,
            self.beam.reach,
            self.beam.curvature_per_mm,
            self._table_steps,
            image.first_sample_depth_mm,
            image.sample_spacing_mm,
            2e3 * self._spectra.carrier_hz / probe.speed_of_sound_m_s,
            out,
        )
        return out

    @cached_property
    def _spectra(self) -> _Spectra:
        return _Spectra(self.beam, self.image.samples)

    @cached_property
    def _table_steps(self) -> FloatArray:
        depth, lateral, elevation = self.beam.depth_mm, self.beam.lateral_mm, self.beam.elevation_mm
        return np.array([depth[0], depth[1] - depth[0], lateral[1], elevation[1]])

    @cached_property
    def _rms(self) -> tuple[FloatArray, float]:
        """RF rms of unit speckle at each sample, and at the focus."""
        frequency = np.fft.rfftfreq(1024, 1.0 / self.beam.probe.sampling_rate_hz)
        rms = np.sqrt(self.beam.echo_power(frequency))
        image = self.image
        depth = image.first_sample_depth_mm + np.arange(image.samples) * image.sample_spacing_mm
        focus = np.interp(self.beam.probe.transmit_focus_mm, self.beam.depth_mm, rms)
        return np.interp(depth, self.beam.depth_mm, rms), float(focus)

    @cached_property
    def _gain(self) -> FloatArray:
        rms, focus = self._rms
        quietest = focus * 10.0 ** (-self.receiver.max_gain_db / 20.0)
        return np.asarray(SPECKLE_RMS_COUNTS / np.maximum(rms, quietest)).astype(np.float32)

    def _noise(self, index: int) -> Complex64Array:
        """Spectrum of one frame's electronic noise, shape (vector, bin)."""
        rng = np.random.default_rng([self.noise_entropy, index])
        low, high = self.receiver.noise_band_hz
        frequency = self._spectra.frequency_hz
        band = np.flatnonzero((frequency >= low) & (frequency <= high))
        _, focus = self._rms
        rms = focus * 10.0 ** (-self.receiver.snr_db / 20.0)
        # irfft of bins of variance 2 s^2 over n samples has variance 4 s^2 bins / n^2.
        scale = rms * self._spectra.length / np.sqrt(4.0 * band.size)
        noise = np.zeros((self.image.vectors, frequency.size), np.complex64)
        white = rng.standard_normal((self.image.vectors, band.size, 2), dtype=np.float32)
        noise[:, band] = scale * white.view(np.complex64)[..., 0]
        return noise

    def _near(self, medium_from_image: RigidTransform) -> list[Scatterers]:
        """Scatterers within the beam's reach of the image plane, in the image frame."""
        margin, thick = self.beam.lateral_extent_mm, float(self.beam.elevation_extent_mm.max())
        low = np.array([-margin, self.beam.depth_mm[0], -thick])
        high = np.array([self.image.width_mm + margin, self.beam.depth_mm[-1], thick])
        corners = np.array(
            [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (-thick, thick)]
        )
        seen = medium_from_image.apply(corners)
        image_from_medium = medium_from_image.inv().as_matrix()
        blocks = []
        for position, strength in self.medium.within(seen.min(axis=0), seen.max(axis=0)):
            moved = position @ image_from_medium[:3, :3].T + image_from_medium[:3, 3]
            kept = self._in_reach(moved, low, high)
            blocks.append((moved[kept], strength[kept]))
        return blocks

    def _in_reach(self, position: FloatArray, low: FloatArray, high: FloatArray) -> npt.NDArray[np.intp]:
        thick = np.interp(position[:, 1], self.beam.depth_mm, self.beam.elevation_extent_mm)
        inside = np.abs(position[:, 2]) <= thick
        inside &= (position[:, 0] > low[0]) & (position[:, 0] < high[0])
        inside &= (position[:, 1] > low[1]) & (position[:, 1] < high[1])
        return np.flatnonzero(inside)


class _Spectra:
    """Pulse spectra of the nodes on the FFT's bins, and the way from baseband echoes to RF."""

    def __init__(self, beam: BeamTable, samples: int) -> None:
        rate = beam.probe.sampling_rate_hz
        self.samples = samples
        self.length = next_fast_len(samples + _GUARD_SAMPLES, real=True)
        self.frequency_hz = np.arange(self.length // 2 + 1) * rate / self.length
        self._carrier_bin = round(beam.probe.centre_frequency_hz / rate * self.length)
        self.carrier_hz = float(self.frequency_hz[self._carrier_bin])
        spectra = beam.node_spectra(self.frequency_hz)
        self._band = np.flatnonzero(spectra.any(axis=0))
        self._pulse = np.ascontiguousarray(spectra[:, self._band].T).astype(np.float32)

    def waveforms(self, echoes: Complex64Array, noise: Complex64Array) -> npt.NDArray[np.float32]:
        """RF, shape (vector, sample): each node's echoes through its pulse, and the noise, summed."""
        # The band holds less than half of the bins: baseband bins wrap, so negative ones are in place.
        baseband = fft(echoes, axis=1, workers=2)[:, self._band - self._carrier_bin]
        spectrum = noise
        spectrum[:, self._band] += np.einsum("vfk,fk->vf", baseband, self._pulse)
        wave: npt.NDArray[np.float32] = irfft(spectrum, self.length, axis=1, workers=2)[:, : self.samples]
        return wave


def _by_lateral_cell(
    position: FloatArray, vector_mm: FloatArray, extent_mm: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Sort by lateral cell, then depth, so that a vector reads a run of cells with the table in cache."""
    if vector_mm.size < 1:
        raise InvalidInputError("expected at least one vector, got none")
    width = 0.3
    left = vector_mm[0] - extent_mm
    cell = np.floor((position[:, 0] - left) / width).astype(np.int64)
    cells = int(np.floor((vector_mm[-1] + extent_mm - left) / width)) + 1
    order = np.lexsort((position[:, 1], cell))
    start = np.searchsorted(cell[order], np.arange(cells + 1)).astype(np.int64)
    first = np.clip(np.floor((vector_mm - extent_mm - left) / width), 0, cells).astype(np.int64)
    last = np.clip(np.floor((vector_mm + extent_mm - left) / width) + 1, 0, cells).astype(np.int64)
    return order, start, first, last
