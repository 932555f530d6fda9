"""Statistics of a sweep's images: speckle size, spectra, grey levels, static echoes.

The size of speckle along the vectors is the pulse's, across them the aperture's over depth; neither depends
on what is scanned as long as it scatters as a phantom does; patches whose contrast denies that do not count.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import fft

from speckle3d.core.arrays import Complex64Array, Float32Array, FloatArray
from speckle3d.core.curves import EchoSpectra, SpeckleSize
from speckle3d.core.images import spread_frames
from speckle3d.core.sweep import RFSettings, Sweep
from speckle3d.matching.matcher import FrameMatcher, ReadyFrame
from speckle3d.matching.quality import FrameFeatures, correlation

FRAMES = 16
"""Frames looked at, evenly spread over the sweep: one in each 0.5 mm of 8 mm; nearer ones see the same
speckle."""
CONTRAST = (0.75, 1.15)
"""Standard deviation over mean of intensity in patches that count: 1 for speckle, scattered by its 50 to 90
cells. Coherent structure is above; its patches look coarser than speckle."""
SPECKLE_SPREAD_DB = 10.0 * np.abs(np.diff(np.log10(-np.log([0.9, 0.5, 0.1]))))
"""Distances of the 10th and the 90th percentile of an exponential variable's decibels from the median."""


class Look(NamedTuple):
    """Statistics of one frame.

    Attributes
    ----------
    size, power : ndarray, shape (2, p) and (f, p)
        Of each patch's speckle, mm, and of its echo by frequency; NaN where it is not usable.
    level : ndarray, shape (3, q)
        Logarithms of the usable patches' 10th, 50th and 90th percentiles of intensity.
    sampled : ndarray, shape (s,)
        Power of the samples as read, by frequency.
    echo : ndarray, shape (p, k)
        Of each patch, of unit power.
    step : float
        Between neighbouring grey levels that occur; 0 of echoes.
    """

    size: FloatArray
    power: FloatArray
    level: FloatArray
    sampled: FloatArray
    echo: Float32Array
    step: float


class Texture:
    """Image statistics of some frames, collected while they are matched.

    Parameters
    ----------
    matcher : FrameMatcher

    Attributes
    ----------
    signal : RFSettings or BModeSettings
    looks : dict of int to Look
        By the frame's number, increasing.
    """

    def __init__(self, matcher: FrameMatcher) -> None:
        self.signal, self._patches = matcher.signal, matcher.patches
        self._edge_fraction = matcher.key.edge_fraction
        self.looks: dict[int, Look] = {}

    def keep(self, number: int, ready: ReadyFrame) -> None:
        """Measure the usable patches of one frame, later than those before."""
        echo, usable, patches = ready.echo, ready.features.usable, self._patches
        images = echo.intensity, ready.frame.echo if ready.frame.echo.size else ready.frame.image
        intensity, local_tiles = map(patches.tiles, images)
        power, level, sample_power = np.zeros((0, len(patches))), np.zeros((3, 0)), np.zeros(0)
        step = 0.0
        if echo.analytic is not None:
            # A vector of each column of patches; frames that are not finite are flagged.
            vectors = np.nan_to_num(ready.samples[np.unique(patches.first[:, 0])], posinf=0.0, neginf=0.0)
            sample_power = (np.abs(fft.fft(vectors)) ** 2).mean(axis=0)
            power = _powers(patches.tiles(echo.analytic))
        elif usable.any():
            thinned = intensity[usable, :, ::4].reshape(int(usable.sum()), -1)
            level = np.log(np.percentile(thinned, [10, 50, 90], axis=1))
            step = float(np.median(np.diff(np.unique(ready.samples))))
        size = _sizes(intensity, ready.features, patches.spacing_mm)
        size, power = (np.where(usable, values, np.nan) for values in (size, power))
        self.looks[number] = Look(size, power, level, sample_power, _unit_echoes(local_tiles), step)

    def speckle_size(self) -> SpeckleSize:
        """Lateral and axial size of speckle in each row of patches.

        Returns
        -------
        SpeckleSize
            Of shape (r,); NaN where no patch holds fully developed speckle.
        """
        size = np.ma.median(self._rows("size"), axis=(0, 3))  # type: ignore[no-untyped-call]
        return SpeckleSize(*size.filled(np.nan))

    def grey_spread_db(self) -> FloatArray:
        """Distances of the 10th and the 90th percentile from the median, dB, of the median patch, shape (2,).

        Speckle's if nothing tells otherwise, as in echoes.
        """
        levels = [look.level for look in self.looks.values() if look.level.size]
        if not levels:
            return SPECKLE_SPREAD_DB
        low, middle, high = 10.0 * np.log10(np.e) * np.concatenate(levels, axis=1)
        return np.asarray(np.median([middle - low, high - middle], axis=1))

    def spectra(self) -> EchoSpectra | None:
        """Power spectrum within the band that is matched, at each row of patches; None of grey levels.

        RF and I/Q of one sweep have the same: both are band-passed and resampled alike before they are
        matched. Every patch counts the same, however bright.
        """
        if not isinstance(self.signal, RFSettings):
            return None
        power = self._rows("power").mean(axis=(0, 3)).T
        has_echo = ~np.ma.getmaskarray(power).any(axis=1)
        if not has_echo.any():
            return None
        rate_hz = 1e3 * self.signal.speed_of_sound_m_s / (2.0 * self._patches.spacing_mm[1])
        low, high = self.signal.bandwidth_hz
        # The band's centre was shifted to zero.
        frequency = fft.fftshift(fft.fftfreq(power.shape[1], 1.0 / rate_hz)) + (low + high) / 2.0
        edge = self._edge_fraction * (high - low)
        band = (frequency > low - edge) & (frequency < high + edge)
        return EchoSpectra(
            self._patches.row_depth_mm[has_echo], frequency[band], power.data[has_echo][:, band]
        )

    def _rows(self, name: str) -> Any:
        """Values of all frames by rows and columns, shape (n, k, r, c), masked where they are not usable."""
        values = np.stack([getattr(look, name) for look in self.looks.values()])
        return np.ma.masked_invalid(self._patches.rows_of(values))


def leave_out_standing(sweep: Sweep, matcher: FrameMatcher) -> list[int]:
    """Leave out what stands still in some frames of a sweep, whose numbers are returned."""
    numbers: list[int] = spread_frames(len(sweep), FRAMES).tolist()
    matcher.leave_out([matcher.extractor.echo(sweep.frames[number]) for number in numbers])
    return numbers


def measured_texture(sweep: Sweep, matcher: FrameMatcher) -> Texture:
    """Texture of some frames of a sweep, without what stands still in them."""
    texture = Texture(matcher)
    for number in leave_out_standing(sweep, matcher):
        texture.keep(number, matcher.ready(sweep.frames[number]))
    return texture


def _powers(echo: Complex64Array) -> FloatArray:
    """Power spectrum of each patch, shape (p, v, s), of unit sum, shape (f, p), frequencies rising."""
    spectrum = fft.fft(echo * np.hanning(echo.shape[-1]).astype(np.float32), axis=-1)
    power = (spectrum.real**2 + spectrum.imag**2).sum(axis=1, dtype=float).T
    return fft.fftshift(power / np.maximum(power.sum(axis=0), 1e-30), axes=0)


def _sizes(intensity: Float32Array, features: FrameFeatures, spacing_mm: FloatArray) -> FloatArray:
    """Lateral and axial size of speckle, mm, shape (2, p), of patches of shape (p, v, s).

    NaN unless it is fully developed.
    """
    with np.errstate(all="ignore"):  # Flat patches come out as NaN.
        rho = np.stack([features.lateral, correlation(intensity[..., :-1], intensity[..., 1:])])
        # The width of a Gaussian with this correlation one sample off.
        size = spacing_mm[:, None] / np.sqrt(-2.0 * np.log(np.clip(rho, 1e-3, 0.999)))
        fair = (features.contrast > CONTRAST[0]) & (features.contrast < CONTRAST[1])
    return np.where(fair, size, np.nan)


def _unit_echoes(tiles: Float32Array) -> Float32Array:
    """Echo of each patch, shape (p, 2, v, s), or intensity, less its mean and of unit power, shape (p, k)."""
    echoes = tiles.reshape(len(tiles), -1)
    echoes = echoes - echoes.mean(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(echoes / np.linalg.norm(echoes, axis=1, keepdims=True))
