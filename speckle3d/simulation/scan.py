"""RF frames from a beam, a medium and poses, computed when read and the same each time."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import fft, irfft, next_fast_len
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import AnyArray, Complex64Array, Float32Array, FloatArray, IntArray
from speckle3d.core.geometry import rotation_from_fixed_angles
from speckle3d.core.grid import ImageGrid
from speckle3d.kernels.scatter import EchoGrid, scatter_echoes
from speckle3d.simulation.beam import BeamTable
from speckle3d.simulation.medium import TiledMedium

_FULL_SCALE = 8191
"""14 bits, signed."""

SPECKLE_RMS_COUNTS = 350.0
"""Fully developed speckle of unit strength after time-gain compensation: 27 dB below full scale."""

_NOISE_BAND_HZ = (2e6, 13e6)
"""The amplifier's pass band."""

_MOST_GAIN = 100.0
"""Most that time-gain compensation, which is fixed for a uniform medium, amplifies over the focus."""

_GUARD_SAMPLES = 160
"""Longer than the pulse (its raised-cosine spectrum is 10 MHz wide): keeps the FFT's ends apart."""


@dataclass(frozen=True)
class SimulatedFrames:
    """RF frames of one sweep; a frame is computed when it is indexed, so a sweep of any length fits.

    Parameters
    ----------
    beam : BeamTable
    medium : TiledMedium
    medium_from_image : RigidTransform, length n
    image : ImageGrid
    snr_db : float
        Unit-strength speckle over electronic noise at the transmit focus.
    noise_entropy : int
        With a frame's index, the seed of its electronic noise.
    """

    beam: BeamTable
    medium: TiledMedium
    medium_from_image: RigidTransform
    image: ImageGrid
    snr_db: float = 40.0
    noise_entropy: int = 0
    any_thread = computed = True
    dtype = np.dtype(np.int16)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, vectors, samples."""
        return len(self.medium_from_image), self.image.vectors, self.image.samples

    def __getitem__(self, index: int) -> AnyArray:
        """One frame, shape (vector, sample), 14-bit counts."""
        counts: Float32Array = self.waveforms(range(self.shape[0])[index]) * self._levels[0]
        return np.clip(np.rint(counts), -_FULL_SCALE, _FULL_SCALE).astype(np.int16)

    def waveforms(self, index: int) -> Float32Array:
        """RF of frame `index` before gain, shape (vector, sample): echoes through their pulses, and noise."""
        band, pulse = self._pulses
        # The band holds less than half of the bins: baseband bins wrap, so negative ones are in place.
        baseband = fft(self._echoes(index), axis=1)[:, band - self._carrier_bin]
        spectrum = self._noise(index)
        spectrum[:, band] += np.einsum("vfk,fk->vf", baseband, pulse)
        wave: Float32Array = irfft(spectrum, self._length, axis=1)[:, : self.image.samples]
        return wave

    def _echoes(self, index: int) -> Complex64Array:
        """Baseband echoes of frame `index`, shape (vector, sample, component of the beam)."""
        probe, image = self.beam.probe, self.image
        out = np.zeros((image.vectors, self._length, len(self.beam.components)), np.complex64)
        carrier = 2e-3 * float(self._frequency_hz[self._carrier_bin]) / probe.signal.speed_of_sound_m_s
        grid = EchoGrid(image.first_sample_depth_mm, image.sample_spacing_mm, carrier)
        # A fan's face lies deeper in the image at its middle than at its ends; reflectors see it as flat.
        number = np.arange(1 if image.fan is None else image.vectors)
        face_mm = image.mm(number, -image.first_sample_depth_mm / image.sample_spacing_mm)
        middle = np.array([0.0, face_mm[len(number) // 2, 1], 0.0])
        medium_from_face = self.medium_from_image[index] * RigidTransform.from_translation(middle)
        axes = rotation_from_fixed_angles(image.angle_rad(number), 0.0, 0.0).as_matrix()[:, :2, :2]
        offsets = axes @ (middle[:2] - face_mm)[:, :, None]
        place = medium_from_face.inv().as_matrix(), np.concatenate([axes, offsets], axis=-1)
        low, high = np.pad(image.extent_mm, ((0, 0), (0, 1))) - middle
        lateral, elevation = self.beam.extent_mm
        reach = np.array([lateral, lateral, elevation])
        for block in self.medium.scatterers(medium_from_face, (low - reach, high + reach)):
            scatter_echoes(*block, probe.pitch_mm, *place, self.beam.field, grid, out.view(np.float32))
        return out

    @cached_property
    def _length(self) -> int:
        """Samples of the FFT."""
        return int(next_fast_len(self.image.samples + _GUARD_SAMPLES, real=True))

    @cached_property
    def _frequency_hz(self) -> FloatArray:
        """Frequencies of the FFT's bins."""
        return np.arange(self._length // 2 + 1) * self.beam.probe.signal.sampling_rate_hz / self._length

    @property
    def _carrier_bin(self) -> int:
        probe = self.beam.probe
        return round(probe.signal.centre_frequency_hz / probe.signal.sampling_rate_hz * self._length)

    @cached_property
    def _pulses(self) -> tuple[IntArray, Complex64Array]:
        """Bins of the pulse's band, and each component's pulse spectrum in them, shape (bin, component)."""
        spectra = self.beam.spectra(self._frequency_hz)
        band = np.flatnonzero(spectra.any(axis=0))
        return band, spectra[:, band].T.astype(np.complex64, order="C")

    @cached_property
    def _levels(self) -> tuple[Float32Array, float]:
        """Gain at each sample, and RF rms of unit speckle at the focus."""
        probe, image = self.beam.probe, self.image
        rms = np.sqrt(self.beam.echo_power(np.linspace(0.0, probe.signal.sampling_rate_hz / 2.0, 513)))
        depth = image.first_sample_depth_mm + np.arange(image.samples) * image.sample_spacing_mm
        focus = float(np.interp(probe.transmit_focus_mm, self.beam.depth_mm, rms))
        level = np.maximum(np.interp(depth, self.beam.depth_mm, rms), focus / _MOST_GAIN)
        return (SPECKLE_RMS_COUNTS / level).astype(np.float32), focus

    def _noise(self, index: int) -> Complex64Array:
        """Spectrum of one frame's electronic noise, shape (vector, bin)."""
        rng = np.random.default_rng([self.noise_entropy, index])
        low, high = _NOISE_BAND_HZ
        frequency = self._frequency_hz
        band = np.flatnonzero((frequency >= low) & (frequency <= high))
        rms = self._levels[1] * 10.0 ** (-self.snr_db / 20.0)
        # irfft of bins of variance 2 s^2 over n samples has variance 4 s^2 bins / n^2.
        scale = rms * self._length / np.sqrt(4.0 * band.size)
        noise = np.zeros((self.image.vectors, frequency.size), np.complex64)
        white = rng.standard_normal((self.image.vectors, band.size, 2), dtype=np.float32)
        noise[:, band] = scale * white.view(np.complex64)[..., 0]
        return noise
