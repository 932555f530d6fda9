"""Frames to echo intensity: zero-phase band-pass, analytic signal, squared magnitude.

Intensity, not amplitude, is what is correlated later: for fully developed speckle its correlation is the
squared magnitude of the complex one. The analytic signal is band-limited, so it is resampled on the way back
from the frequency domain to the coarsest rate that still holds the intensity's bandwidth. Echoes, above all
I/Q, may have been sampled more coarsely than that, and then the rate rises.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy import fft

from speckle3d.core.arrays import Complex64Array, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, ImageGrid, RFSettings, Sweep
from speckle3d.kernels.intensity import (
    equalise_echo,
    local_mean,
    place_band,
    place_band_of_real,
    squared_magnitude,
)

_RATE_OVER_BAND = 100 / 27
"""Rate of the intensity's samples over the width of the pass-band, edges included, whatever the echoes were
sampled at: one sweep then has the same patches and lengths as RF and as I/Q. Intensity holds frequencies up
to that width, so twice the width is the least; half as many samples again let a parabola through its
correlation at neighbouring samples be read between them. Documented accuracies were measured at this rate, a
third of 66.7 MHz for echoes of 5 to 10 MHz."""

_RATIO_TOLERANCE = 1e-4
"""Of the rate; 4 um at 40 mm."""


class IntensitySettings(BaseModel):
    """How frames become intensity."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    edge_fraction: float = Field(
        0.1, gt=0, le=0.5, description="Width of each raised-cosine band edge over the bandwidth."
    )
    equalise_mm: float = Field(
        2.0,
        ge=0,
        description="Side of the window whose mean is divided out before correlation; 0: none.",
    )


@dataclass(frozen=True)
class _Resampling:
    """Fourier bins of the band and where they go in the inverse transform of another length.

    Real rows of even length are transformed as half as many complex numbers, and only the band is made of
    what comes out; `mirrored` is then what each bin takes from its mirror image.
    """

    length: int
    out_length: int
    runs: IntArray
    """First bin, its place in the inverse transform and count, of bins that follow one another in both."""
    weights: Complex64Array
    mirrored: Complex64Array | None

    @property
    def step(self) -> float:
        """Distance of the samples that come out, in samples that go in."""
        return self.length / self.out_length


class IntensityExtractor:
    """Makes intensity images of one sweep's frames.

    Attributes
    ----------
    grid : ImageGrid
        Where the intensity samples lie; coarser in depth than the RF samples.
    """

    def __init__(
        self, signal: RFSettings | BModeSettings, grid: ImageGrid, settings: IntensitySettings | None = None
    ) -> None:
        self.settings = settings or IntensitySettings()
        self.signal = signal
        self.grid = grid
        self._frame_shape = (grid.vectors, grid.samples)
        self._plan: _Resampling | None = None
        if isinstance(signal, RFSettings):
            self._plan = _plan_resampling(signal, grid.samples, self.settings.edge_fraction)
            step = self._plan.step
            samples = int((grid.samples - 1) / step) + 1
            self.grid = replace(grid, samples=samples, sample_spacing_mm=grid.sample_spacing_mm * step)

    @classmethod
    def for_sweep(cls, sweep: Sweep, settings: IntensitySettings | None = None) -> IntensityExtractor:
        """Plan for the frames of `sweep`."""
        return cls(sweep.signal, sweep.grid, settings)

    def analytic(self, frame: npt.NDArray[Any]) -> Complex64Array:
        """Band-passed analytic signal about the band's centre, resampled in depth.

        Parameters
        ----------
        frame : ndarray, shape (vector, sample)
            RF samples, real, or I/Q, complex.

        Returns
        -------
        ndarray of complex64, shape (vector, grid.samples)

        Raises
        ------
        InvalidInputError
            If the frame has another shape, is complex where it should be real or the other way round, or the
            sweep holds B-mode images.
        """
        if self._plan is None or not isinstance(self.signal, RFSettings):
            raise InvalidInputError("expected RF frames, got B-mode images: there is no phase to recover")
        self._check(frame)
        if np.iscomplexobj(frame) != self.signal.are_complex:
            kind = "complex" if self.signal.are_complex else "real"
            raise InvalidInputError(f"expected {kind} samples, got {frame.dtype}")
        return _resample(frame, self._plan, self.grid.samples)

    def intensity(self, frame: npt.NDArray[Any]) -> Float32Array:
        """Echo intensity, shape (vector, grid.samples), arbitrary units, from RF or B-mode grey levels."""
        if isinstance(self.signal, BModeSettings):
            self._check(frame)
            return _decompress(frame, self.signal)
        return intensity_of(self.analytic(frame))

    def equalise(self, intensity: Float32Array) -> Float32Array:
        """Divide out the local mean, so that echogenicity does not read as speckle that stays.

        Brightness that varies within a patch correlates between frames whatever the probe did.
        """
        if self.settings.equalise_mm == 0:
            return intensity
        mean, floor = self._local_mean(intensity)
        return np.divide(intensity, np.maximum(mean, np.float32(floor), out=mean), out=mean)

    def equalise_echo(
        self, analytic: Complex64Array, intensity: Float32Array
    ) -> tuple[Float32Array, Float32Array]:
        """Divide out the local mean of an echo too, whose intensity is then the equalised one.

        Returns
        -------
        image : ndarray of float32, shape (vector, grid.samples)
            As from `equalise`.
        echo : ndarray of float32, shape (2, vector, grid.samples)
            Real and imaginary parts.
        """
        if self.settings.equalise_mm == 0:
            return intensity, np.stack([analytic.real, analytic.imag])
        mean, floor = self._local_mean(intensity)
        image, parts = np.empty(mean.shape, np.float32), np.empty((2, *mean.shape), np.float32)
        equalise_echo(_in_turn(analytic), np.ascontiguousarray(intensity), mean, floor, image, parts)
        return image, parts

    def _local_mean(self, intensity: Float32Array) -> tuple[Float32Array, float]:
        """Mean over the window about each sample, and the least to divide by."""
        sides = (self.grid.vector_pitch_mm, self.grid.sample_spacing_mm)
        half = np.array([int(self.settings.equalise_mm / 2 / side) for side in sides])
        mean = np.empty(intensity.shape, np.float32)
        return mean, local_mean(np.ascontiguousarray(intensity, dtype=np.float32), half, mean)

    def _check(self, frame: npt.NDArray[Any]) -> None:
        if frame.shape != self._frame_shape:
            raise InvalidInputError(f"expected a frame of shape {self._frame_shape}, got {frame.shape}")


def intensity_of(analytic: Complex64Array) -> Float32Array:
    """Squared magnitude."""
    out = np.empty(analytic.shape, np.float32)
    squared_magnitude(_in_turn(analytic), out)
    return out


def two_way_wavenumber(signal: RFSettings) -> float:
    """Phase per depth, rad/mm, that the analytic signal was freed of: the band's centre, there and back."""
    return float(4e-3 * np.pi * np.mean(signal.bandwidth_hz) / signal.speed_of_sound_m_s)


def _plan_resampling(signal: RFSettings, samples: int, edge_fraction: float) -> _Resampling:
    low, high = signal.bandwidth_hz
    edge = edge_fraction * (high - low)
    padding = int(2 * signal.sampling_rate_hz / edge)
    ratio = signal.sampling_rate_hz / (_RATE_OVER_BAND * (high - low + 2 * edge))
    length, out_length = _transform_lengths(samples + padding, ratio)
    frequency = signal.bin_frequency_hz(length)
    weights = _band_weights(frequency, low, high, edge)
    bins = np.flatnonzero(weights)
    bins = bins[np.argsort(frequency[bins])][:out_length]
    destination = (np.arange(bins.size) - bins.size // 2) % out_length
    # Over the lengths' ratio for the inverse transform; the analytic signal is twice the positive half of a
    # real signal's spectrum.
    scale = (1.0 if signal.are_complex else 2.0) * out_length / length
    chosen, mirrored = scale * weights[bins].astype(complex), None
    if not signal.are_complex and length % 2 == 0 and bins[-1] < length // 2:
        turn = 1j * np.exp(-2j * np.pi * bins / length)
        chosen, mirrored = chosen * (1 - turn) / 2, (chosen * (1 + turn) / 2).astype(np.complex64)
    return _Resampling(length, out_length, _runs(bins, destination), chosen.astype(np.complex64), mirrored)


def _runs(bins: IntArray, destination: IntArray) -> IntArray:
    """First bin, first destination and count of the runs in which both rise by one, shape (r, 3)."""
    breaks = np.flatnonzero((np.diff(bins) != 1) | (np.diff(destination) != 1)) + 1
    first = np.concatenate([[0], breaks])
    return np.stack([bins[first], destination[first], np.diff(first, append=bins.size)], axis=1)


def _transform_lengths(samples: int, ratio: float) -> tuple[int, int]:
    """Lengths of the transforms, both fast, of which the first is `ratio` times the second.

    The first fast pair is taken that has that ratio to `_RATIO_TOLERANCE`.
    """
    out_length = fft.next_fast_len(int(np.ceil(samples / ratio)))
    least = out_length
    while out_length <= 2 * least:
        length = fft.next_fast_len(round(out_length * ratio * (1 - _RATIO_TOLERANCE)))
        if abs(length / (out_length * ratio) - 1) <= _RATIO_TOLERANCE:
            return length, out_length
        out_length = fft.next_fast_len(out_length + 1)
    return round(least * ratio), least


def _band_weights(frequency: FloatArray, low: float, high: float, edge: float) -> FloatArray:
    """One inside the band, raised-cosine edges outside it; the lower edge ends before zero frequency."""
    outside = np.maximum((low - frequency) / min(edge, low), (frequency - high) / edge)
    return np.asarray(np.where(outside < 1, np.cos(np.pi / 2 * np.clip(outside, 0, 1)) ** 2, 0.0))


def _resample(frame: npt.NDArray[Any], plan: _Resampling, samples: int) -> Complex64Array:
    rows, given = frame.shape
    kind = np.float32 if plan.mirrored is not None else np.complex64
    padded = np.empty((rows, plan.length), kind)
    padded[:, :given] = frame
    padded[:, given:] = 0
    spectrum = np.asarray(fft.fft(padded.view(np.complex64), axis=1, overwrite_x=True), dtype=np.complex64)
    band: Complex64Array = np.empty((rows, plan.out_length), np.complex64)
    if plan.mirrored is None:
        place_band(_in_turn(spectrum), _in_turn(plan.weights), plan.runs, _in_turn(band))
    else:
        factors = _in_turn(plan.weights), _in_turn(plan.mirrored)
        place_band_of_real(_in_turn(spectrum), *factors, plan.runs, _in_turn(band))
    analytic = np.empty((rows, samples), np.complex64)
    analytic[:] = fft.ifft(band, axis=1, overwrite_x=True)[:, :samples]
    return analytic


def _in_turn(values: Complex64Array) -> Float32Array:
    """Real and imaginary parts in turn."""
    return np.ascontiguousarray(values).view(np.float32)


def _decompress(frame: npt.NDArray[Any], signal: BModeSettings) -> Float32Array:
    """Invert log compression: full scale is 0 dB, zero is the bottom of the dynamic range."""
    if frame.dtype == np.uint8 and frame.size > 256:
        table = _decompress(np.arange(256, dtype=np.float32), signal)
        return np.take(table, frame, out=np.empty(frame.shape, np.float32), mode="clip")
    decibel = (frame.astype(np.float32) / np.float32(signal.full_scale) - 1) * signal.dynamic_range_db
    return np.asarray(10 ** (decibel / 10), dtype=np.float32)
