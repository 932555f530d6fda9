"""Speckle's size and the echo's spectrum by depth, from some frames: marks of a probe and its settings.

The size of speckle along the vectors is the pulse's, across them the aperture's over depth; neither depends
on what is scanned as long as it scatters as a phantom does; patches whose contrast denies that do not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from speckle3d.core.arrays import BoolArray, Complex64Array, Float32Array, FloatArray, IntArray
from speckle3d.core.curves import EchoSpectra, SpeckleSize
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep, read_frame
from speckle3d.matching.matcher import Echo, FrameMatcher
from speckle3d.matching.patches import PatchGrid

FRAMES = 16
"""Frames looked at, evenly spread over the sweep: one in each 0.5 mm of 8 mm; nearer ones see the same
speckle."""
PHANTOM_FRAMES = 48
"""The same of a phantom's sweep, whose texture serves many others."""
CONTRAST = (0.75, 1.15)
"""Standard deviation over mean of intensity in patches that count: 1 for speckle, scattered by its 50 to 90
cells. Coherent structure is above; its patches look coarser than speckle."""
LEAST_PATCHES = 8
"""Patches, over all frames, that a row's size is taken from at least."""
NOISE_QUANTILE = 0.2


class Texture:
    """Speckle's size and the echo's spectrum in the patches of some frames.

    Parameters
    ----------
    signal : RFSettings or BModeSettings
    matcher : FrameMatcher
    """

    def __init__(self, signal: RFSettings | BModeSettings, matcher: FrameMatcher) -> None:
        self._signal, self._patches = signal, matcher.patches
        self._edge_fraction = matcher.key.edge_fraction
        self._sizes: dict[int, FloatArray] = {}
        self._powers: dict[int, FloatArray] = {}

    def keep(self, frame: int, echo: Echo, usable: BoolArray | None = None) -> None:
        """Measure the usable patches of one frame, on any thread; by default all."""
        kept = True if usable is None else usable
        self._sizes[frame] = np.where(kept, _sizes(echo.intensity, self._patches), np.nan)
        if echo.analytic is not None:
            powers = _patch_powers(echo.analytic, self._patches)
            self._powers[frame] = np.where(np.reshape(kept, (-1, 1)), powers, np.nan)

    def speckle_size(self, usable: BoolArray | None = None) -> SpeckleSize:
        """Lateral and axial size of speckle in each row of patches.

        Parameters
        ----------
        usable : ndarray of bool, shape (n,), optional
            Frames that count, if any of those that were looked at do.

        Returns
        -------
        SpeckleSize
            Of shape (r,); NaN where too few patches hold fully developed speckle.
        """
        sizes = self._patches.rows_of(np.stack(_some(self._sizes, usable)))
        lateral, axial = sizes.transpose(1, 2, 0, 3).reshape(*sizes.shape[1:3], -1)
        return SpeckleSize(_medians(lateral), _medians(axial))

    def spectra(self, usable: BoolArray | None = None) -> EchoSpectra | None:
        """Power spectrum within the band that is matched, at each row of patches; None without phase.

        RF and I/Q of one sweep have the same: both are band-passed and resampled alike before they are
        matched. Every patch counts the same, however bright.
        """
        if not self._powers or not isinstance(self._signal, RFSettings):
            return None
        by_row = self._patches.rows_of(np.moveaxis(np.stack(_some(self._powers, usable)), 1, 2))
        by_row = by_row.transpose(2, 0, 3, 1).reshape(by_row.shape[2], -1, by_row.shape[1])
        seen = np.isfinite(by_row).any(axis=(1, 2))
        if not seen.any():
            return None
        power = np.nanmean(by_row[seen], axis=1)
        rate_hz = 1e3 * self._signal.speed_of_sound_m_s / (2.0 * self._patches.spacing_mm[1])
        low, high = self._signal.bandwidth_hz
        # The band's centre was shifted to zero.
        frequency = fft.fftfreq(power.shape[1], 1.0 / rate_hz) + (low + high) / 2.0
        edge = self._edge_fraction * (high - low)
        rising = np.argsort(frequency)
        kept = rising[(frequency[rising] > low - edge) & (frequency[rising] < high + edge)]
        return EchoSpectra(self._patches.row_depth_mm[seen], frequency[kept], power[:, kept])


def measured_texture(sweep: Sweep, matcher: FrameMatcher) -> Texture:
    """Read some frames of a sweep, and measure their texture."""
    texture = Texture(sweep.signal, matcher)
    for frame in spread_frames(len(sweep), FRAMES):
        texture.keep(frame, matcher.echo(read_frame(sweep.frames, frame)))
    return texture


def mean_spectra(spectra: Sequence[EchoSpectra]) -> EchoSpectra | None:
    """Mean of some sweeps' spectra at the depths of the first; None of none."""
    if not spectra:
        return None
    first = spectra[0]
    power = np.mean([each.at(first.depth_mm, first.frequency_hz) for each in spectra], axis=0)
    return EchoSpectra(first.depth_mm, first.frequency_hz, power)


def echo_spectra(sweep: Sweep, depth_mm: FloatArray, height_mm: float) -> tuple[FloatArray, FloatArray]:
    """Power spectrum of the echoes about some depths, noise taken off, over some frames.

    Parameters
    ----------
    depth_mm : ndarray, shape (y,)
    height_mm : float
        Height of the window about each depth.

    Returns
    -------
    frequency_hz : ndarray, shape (f,)
    power : ndarray, shape (y, f)

    Raises
    ------
    InvalidInputError
        If the sweep holds B-mode images, which have no spectrum, or the depths are not in them.
    """
    signal, grid = sweep.signal, sweep.grid
    if not isinstance(signal, RFSettings):
        raise InvalidInputError(f"{sweep.name}: expected RF, whose spectrum can be seen, got B-mode images")
    count = min(round(height_mm / grid.sample_spacing_mm), grid.samples)
    middle = np.rint((depth_mm - grid.first_sample_depth_mm) / grid.sample_spacing_mm).astype(int)
    first = np.clip(middle - count // 2, 0, grid.samples - count)
    if count < 16 or (np.abs(first + count // 2 - middle) > count).any():
        raise InvalidInputError(
            f"{sweep.name}: expected echoes from {depth_mm[0]:.1f} to {depth_mm[-1]:.1f} mm, got images of "
            f"{grid.depth_mm:.1f} mm"
        )
    frequency_hz, bins = spectrum_bins(signal, count)
    window = np.hanning(count).astype(np.float32)
    power = np.zeros((depth_mm.size, bins.size))
    for k in spread_frames(len(sweep), FRAMES):
        frame = sweep.frames[k]
        for row, start in enumerate(first):
            spectrum = np.fft.fft(frame[:, start : start + count] * window, axis=1)[:, bins]
            # Bright structure counts no more than speckle: images are equalised before they are correlated.
            energy = np.abs(spectrum) ** 2
            power[row] += (energy / np.maximum(energy.sum(axis=1, keepdims=True), 1e-30)).mean(axis=0)
    # I/Q hold little beside the band, and nothing where their filter has cut them off.
    quantile = 0.0 if signal.are_complex else NOISE_QUANTILE
    noise = np.quantile(power, quantile, axis=1, keepdims=True)
    return frequency_hz, np.maximum(power - noise, 1e-12 * power.max())


def spread_frames(frames: int, count: int) -> list[int]:
    """Choose at most so many of a sweep's frames, evenly spread."""
    return [int(k) for k in np.unique(np.linspace(0, frames - 1, count).round())]


def _some(by_frame: dict[int, FloatArray], usable: BoolArray | None) -> list[FloatArray]:
    """Return the usable frames' values in order, or all if none is usable."""
    frames = sorted(by_frame)
    sound = [k for k in frames if usable is None or usable[k]]
    return [by_frame[k] for k in sound or frames]


def _patch_powers(echo: Complex64Array, patches: PatchGrid) -> FloatArray:
    """Power spectrum of each patch, of unit sum, shape (p, f)."""
    wide, high = patches.size
    tiles = np.stack([echo[v : v + wide, s : s + high] for v, s in patches.first])
    spectrum = fft.fft(tiles * np.hanning(high).astype(np.float32), axis=-1)
    power = (spectrum.real**2 + spectrum.imag**2).sum(axis=1, dtype=float)
    return np.asarray(power / np.maximum(power.sum(axis=1, keepdims=True), 1e-30))


def _medians(rows: FloatArray) -> FloatArray:
    """Median of each row's finite values; NaN where they are few."""
    known = [row[np.isfinite(row)] for row in rows]
    return np.array([np.median(row) if row.size >= LEAST_PATCHES else np.nan for row in known])


def _sizes(intensity: Float32Array, patches: PatchGrid) -> FloatArray:
    """Lateral and axial size of each patch's speckle, mm, shape (2, p); NaN unless it is fully developed."""
    (wide, high), first = patches.size, patches.first
    tiles = np.stack([intensity[v : v + wide, d : d + high] for v, d in first]).astype(float)
    with np.errstate(all="ignore"):  # Flat patches come out as NaN.
        varying = tiles / tiles.mean(axis=(1, 2), keepdims=True) - 1.0
        contrast = np.sqrt(_mean_product(varying, varying))
        lags = (varying[:, :-1], varying[:, 1:]), (varying[..., :-1], varying[..., 1:])
        rho = np.stack([_mean_product(a, b) / contrast**2 for a, b in lags])
        # The width of a Gaussian with this correlation one sample off.
        size = patches.spacing_mm[:, None] / np.sqrt(-2.0 * np.log(np.clip(rho, 1e-3, 0.999)))
        fair = (contrast > CONTRAST[0]) & (contrast < CONTRAST[1])
    return np.where(fair & np.isfinite(rho), size, np.nan)


def _mean_product(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("pvs,pvs->p", a, b) / (a.shape[1] * a.shape[2]))


def spectrum_bins(signal: RFSettings, count: int) -> tuple[FloatArray, IntArray]:
    """Frequencies above zero that `count` samples hold, increasing, and their bins in ``fft``."""
    frequency_hz = signal.bin_frequency_hz(count)[: None if signal.are_complex else count // 2]
    rising = np.argsort(frequency_hz)
    rising = rising[frequency_hz[rising] >= 0]
    return frequency_hz[rising], rising
