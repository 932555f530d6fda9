"""Frames to echo intensity: zero-phase band-pass, analytic signal, squared magnitude.

Intensity, not amplitude, is what is correlated later: for fully developed speckle its correlation is the
squared magnitude of the complex one. The analytic signal is band-limited, so it is resampled on the way back
from the frequency domain to the coarsest rate that still holds the intensity's bandwidth. Echoes, above all
I/Q, may have been sampled more coarsely than that, and then the rate rises.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field
from scipy import fft
from scipy.ndimage import uniform_filter

from speckle3d.core.arrays import BoolArray, Complex64Array, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.sweep import BModeSettings, RFSettings

_RATE_OVER_BAND = 100 / 27
"""Rate of the intensity's samples over the width of the pass-band, edges included, whatever the echoes were
sampled at: one sweep then has the same patches and lengths as RF and as I/Q. Intensity holds frequencies up
to that width, so twice the width is the least; half as many samples again let a parabola through its
correlation at neighbouring samples be read between them. Documented accuracies were measured at this rate, a
third of 66.7 MHz for echoes of 5 to 10 MHz."""

_DEPARTURE_COST = 100.0
"""Samples are padded by 1 % rather than that the rate departs by 1e-4 from the one above. Over 750 rates of
20 to 100 MHz and bands it departs by 2e-4 (median), at most 2e-3, for a padding of 3 %, at most 26 %; at a
cost of 30 by up to 4e-3, for 11 %. Without departure some pad sevenfold, and one in eight has no lengths."""


class IntensitySettings(BaseModel):
    """Settings of band-pass and equalisation."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    edge_fraction: float = Field(
        0.1, gt=0, le=0.5, description="Width of each raised-cosine band edge over the bandwidth."
    )
    equalise_mm: float = Field(
        2.0,
        ge=0,
        description="Side of the window whose mean is divided out before correlation; 0: none.",
    )


class Echo(NamedTuple):
    """One frame's intensity, shape (vector, sample), and the analytic signal it comes from, if known."""

    intensity: Float32Array
    analytic: Complex64Array | None


class _Resampling(NamedTuple):
    """Fourier bins of the band, and where they go in the inverse transform of another length."""

    length: int
    out_length: int
    bins: IntArray
    destination: IntArray
    weights: Float32Array


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
        self._shape = grid.vectors, grid.samples
        if isinstance(signal, RFSettings):
            self._plan = _plan_resampling(signal, grid.samples, self.settings.edge_fraction)
            step = self._plan.length / self._plan.out_length
            samples = int((grid.samples - 1) / step) + 1
            self.grid = replace(grid, samples=samples, sample_spacing_mm=grid.sample_spacing_mm * step)

    def echo(self, frame: npt.NDArray[Any]) -> Echo:
        """Intensity, arbitrary units, and analytic signal of a frame, each of shape (vector, grid.samples).

        Parameters
        ----------
        frame : ndarray, shape (vector, sample)
            RF samples, real; I/Q, complex; or grey levels of B-mode.

        Raises
        ------
        InvalidInputError
            If the frame has another shape.
        """
        if frame.shape != self._shape:
            raise InvalidInputError(f"expected a frame of shape {self._shape}, got {frame.shape}")
        if isinstance(self.signal, BModeSettings):
            return Echo(_decompress(frame, self.signal), None)
        analytic = self._analytic(frame)
        return Echo(np.square(analytic.real) + np.square(analytic.imag), analytic)

    def _analytic(self, frame: npt.NDArray[Any]) -> Complex64Array:
        """Band-passed analytic signal about the band's centre, resampled in depth."""
        plan, are_complex = self._plan, np.iscomplexobj(frame)
        transform: Any = fft.fft if are_complex else fft.rfft
        spectrum = transform(frame.astype("c8" if are_complex else "f4"), plan.length, axis=1)
        band = np.zeros((len(frame), plan.out_length), np.complex64)
        band[:, plan.destination] = spectrum.take(plan.bins, axis=1) * plan.weights
        return np.ascontiguousarray(fft.ifft(band, axis=1, overwrite_x=True)[:, : self.grid.samples])

    def equalised(self, echo: Echo, counted: BoolArray) -> tuple[Float32Array, Float32Array]:
        """Intensity and, where there is phase, parts of the echo over the local mean; see `Frame`.

        Brightness that varies within a patch correlates between frames whatever the probe did: with the local
        mean divided out, echogenicity does not read as speckle that stays. Nor does what is left out: it
        counts in no mean and departs from none, so that a shadow's edge is no pattern.

        Parameters
        ----------
        counted : ndarray of bool, shape (vector, grid.samples)
            Samples that are not left out.
        """
        gain, parts = self._gain(echo.intensity, counted), np.empty((2, 0, 0), np.float32)
        gain[~counted] = 0.0
        image = echo.intensity * gain
        image[~counted] = 1.0
        if echo.analytic is not None:
            parts = np.sqrt(gain) * np.stack([echo.analytic.real, echo.analytic.imag])
        return image, parts

    def _gain(self, intensity: Float32Array, counted: BoolArray) -> Float32Array:
        """One over the local mean; ones if nothing is to be equalised."""
        if self.settings.equalise_mm == 0:
            return np.ones_like(intensity)
        sides = (self.grid.vector_pitch_mm, self.grid.sample_spacing_mm)
        wide, high = (2 * int(self.settings.equalise_mm / 2 / side) + 1 for side in sides)
        mean = uniform_filter(intensity * counted, (wide, high), mode="nearest")
        mean = np.maximum(mean, np.finfo(np.float32).tiny)
        if counted.all():
            return np.reciprocal(mean)
        share = uniform_filter(counted.astype(np.float32), (wide, high), mode="nearest")
        # Less than half a sample is rounding: nothing counts near.
        share[share <= 0.5 / (wide * high)] = 0.0
        return share / mean


def two_way_wavenumber(signal: RFSettings) -> float:
    """Two-way wavenumber of the band's centre, rad/mm, removed by demodulation."""
    return float(4e-3 * np.pi * np.mean(signal.bandwidth_hz) / signal.speed_of_sound_m_s)


def _plan_resampling(signal: RFSettings, samples: int, edge_fraction: float) -> _Resampling:
    """Fast lengths of both transforms, the first even, and the bins of the band."""
    low, high = signal.bandwidth_hz
    edge = edge_fraction * (high - low)
    padding = int(2 * signal.sampling_rate_hz / edge)
    ratio = signal.sampling_rate_hz / (_RATE_OVER_BAND * (high - low + 2 * edge))
    least = int(np.ceil((samples + padding) / ratio))
    out_lengths = map(fft.next_fast_len, range(least, 2 * least))
    pairs = ((2 * fft.next_fast_len(round(n * ratio / 2)), n) for n in out_lengths)
    length, out_length = min(
        pairs, key=lambda pair: pair[1] / least + _DEPARTURE_COST * abs(pair[0] / pair[1] / ratio - 1)
    )
    frequency = signal.bin_frequency_hz(length)
    weights = band_weights(frequency, low, high, edge)
    bins = np.flatnonzero(weights)
    bins = bins[np.argsort(frequency[bins])]
    destination = (np.arange(bins.size) - bins.size // 2) % out_length
    # Over the lengths' ratio for the inverse transform; the analytic signal is twice the positive half of a
    # real signal's spectrum.
    scale = (1.0 if signal.are_complex else 2.0) * out_length / length * weights[bins]
    return _Resampling(length, out_length, bins, destination, scale.astype(np.float32))


def band_weights(frequency: FloatArray, low: float, high: float, edge: float) -> FloatArray:
    """One inside the band, raised-cosine edges outside it; the lower edge ends before zero frequency."""
    outside = np.maximum((low - frequency) / min(edge, low), (frequency - high) / edge)
    return np.asarray(np.where(outside < 1, np.cos(np.pi / 2 * np.clip(outside, 0, 1)) ** 2, 0.0))


def _decompress(frame: npt.NDArray[Any], signal: BModeSettings) -> Float32Array:
    """Invert log compression: full scale is 0 dB, zero is the bottom of the dynamic range."""
    decibel = (frame.astype(np.float32) / np.float32(signal.full_scale) - 1) * signal.dynamic_range_db
    return np.ascontiguousarray(10 ** (decibel / 10), dtype=np.float32)
