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
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep, read_frame
from speckle3d.core.threads import ahead
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
SPECKLE_BALANCE = 1.57
"""Distance of the 10th over that of the 90th percentile from the median, of speckle's decibels."""
LEAST_PATCHES = 8
"""Patches, over all frames, that a row's size is taken from at least."""


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
        self._levels: dict[int, FloatArray] = {}

    def keep(self, frame: int, echo: Echo, usable: BoolArray | None = None) -> None:
        """Measure the usable patches of one frame, on any thread; by default all."""
        kept = True if usable is None else usable
        self._sizes[frame] = np.where(kept, _sizes(echo.intensity, self._patches), np.nan)
        if echo.analytic is not None:
            self._powers[frame] = np.where(kept, _patch_powers(echo.analytic, self._patches), np.nan)
        elif usable is not None and usable.any():
            tiles = self._patches.tiles(echo.intensity, 4)[usable].reshape(int(usable.sum()), -1)
            tiles.sort(axis=1)
            tenth = tiles.shape[1] // 10
            self._levels[frame] = np.log(tiles[:, [tenth, 5 * tenth, 9 * tenth]].T)

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
        rows = np.moveaxis(self._rows(self._sizes, usable), 0, -1)
        known = np.isfinite(rows).sum(axis=(2, 3)) >= LEAST_PATCHES
        size = np.full(known.shape, np.nan)
        size[known] = np.nanmedian(rows[known], axis=(1, 2))
        return SpeckleSize(*size)

    def balance(self) -> float:
        """Spread of dark over that of bright decibels, about the median; of echoes that of speckle."""
        if not self._levels:
            return SPECKLE_BALANCE
        low, middle, high = np.concatenate(list(self._levels.values()), axis=1)
        return float(np.median(middle - low) / max(float(np.median(high - middle)), 1e-9))

    def spectra(self, usable: BoolArray | None = None) -> EchoSpectra | None:
        """Power spectrum within the band that is matched, at each row of patches; None without phase.

        RF and I/Q of one sweep have the same: both are band-passed and resampled alike before they are
        matched. Every patch counts the same, however bright.
        """
        if not self._powers or not isinstance(self._signal, RFSettings):
            return None
        rows = self._rows(self._powers, usable)
        seen = np.isfinite(rows).any(axis=(0, 1, 3))
        if not seen.any():
            return None
        power = np.nanmean(rows[:, :, seen], axis=(0, 3)).T
        rate_hz = 1e3 * self._signal.speed_of_sound_m_s / (2.0 * self._patches.spacing_mm[1])
        low, high = self._signal.bandwidth_hz
        # The band's centre was shifted to zero.
        frequency = fft.fftfreq(power.shape[1], 1.0 / rate_hz) + (low + high) / 2.0
        edge = self._edge_fraction * (high - low)
        rising = np.argsort(frequency)
        kept = rising[(frequency[rising] > low - edge) & (frequency[rising] < high + edge)]
        return EchoSpectra(self._patches.row_depth_mm[seen], frequency[kept], power[:, kept])

    def _rows(self, by_frame: dict[int, FloatArray], usable: BoolArray | None) -> FloatArray:
        """Values of the usable frames, or of all if none is, by rows and columns, shape (n, k, r, c)."""
        frames = sorted(by_frame)
        sound = [k for k in frames if usable is None or usable[k]]
        return self._patches.rows_of(np.stack([by_frame[k] for k in sound or frames]))


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


def spread_frames(frames: int, count: int) -> list[int]:
    """Choose at most so many of a sweep's frames, evenly spread."""
    return [int(k) for k in np.unique(np.linspace(0, frames - 1, count).round())]


def _patch_powers(echo: Complex64Array, patches: PatchGrid) -> FloatArray:
    """Power spectrum of each patch, of unit sum, shape (f, p)."""
    spectrum = fft.fft(patches.tiles(echo) * np.hanning(patches.size[1]).astype(np.float32), axis=-1)
    power = (spectrum.real**2 + spectrum.imag**2).sum(axis=1, dtype=float).T
    return np.asarray(power / np.maximum(power.sum(axis=0), 1e-30))


def _sizes(intensity: Float32Array, patches: PatchGrid) -> FloatArray:
    """Lateral and axial size of each patch's speckle, mm, shape (2, p); NaN unless it is fully developed."""
    varying = patches.tiles(intensity)
    with np.errstate(all="ignore"):  # Flat patches come out as NaN.
        varying /= varying.mean(axis=(1, 2), keepdims=True)
        varying -= 1.0
        contrast = varying.std(axis=(1, 2))
        lateral, axial = varying[:, :-1] * varying[:, 1:], varying[..., :-1] * varying[..., 1:]
        rho = np.stack([lateral.mean(axis=(1, 2)), axial.mean(axis=(1, 2))]) / contrast**2
        # The width of a Gaussian with this correlation one sample off.
        size = patches.spacing_mm[:, None] / np.sqrt(-2.0 * np.log(np.clip(rho, 1e-3, 0.999)))
    fair = (contrast > CONTRAST[0]) & (contrast < CONTRAST[1]) & np.isfinite(rho)
    return np.where(fair, size, np.nan)


def standing_share(sweep: Sweep, matcher: FrameMatcher, pairs: IntArray) -> FloatArray:
    """Share of each patch's power that is the same in all frames: median over their pairs.

    Echoes that stay where they are while the probe moves are reverberation, side lobes, electronics. Speckle
    of places a beam's width and more apart has nothing in common, so that the product of two such frames'
    echoes, sample by sample and without looking for in-plane motion, averages to zero. What is added to every
    frame alike does not: the product's mean is its share of the power. The tissue's own structure moves in
    the image as the hand wanders, and a quarter of a wavelength in depth turns its phase round.

    Parameters
    ----------
    pairs : ndarray of int, shape (m, 2)
        Frames far apart, read anew and all held at once. The median lets some of them see what others do, as
        on the way back.

    Returns
    -------
    ndarray, shape (p,)
        Of power, or with images of intensity of its variation; of either sign and about zero where nothing
        stays. NaN where there is no echo.
    """

    def look(frame: int) -> Float32Array:
        image, echo = matcher.equalised(matcher.echo(read_frame(sweep.frames, frame)))
        tiles = matcher.patches.tiles(echo if matcher.of_echo else image)
        tiles = tiles.reshape(len(tiles), -1)
        if not matcher.of_echo:
            tiles = tiles - tiles.mean(axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(tiles / np.linalg.norm(tiles, axis=1, keepdims=True))

    frames, at = np.unique(pairs, return_inverse=True)
    tiles = np.stack(list(ahead(look, frames.tolist())), axis=1)
    shared = tiles @ tiles.transpose(0, 2, 1)
    return np.asarray(np.median(shared[:, *at.reshape(-1, 2).T], axis=1), dtype=float)
