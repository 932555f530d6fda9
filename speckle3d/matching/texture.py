"""Speckle's size by depth and the echo's spectrum, from some frames: marks of a probe and its settings.

The size of speckle along the vectors is the pulse's, across them the aperture's over depth; neither depends
on what is scanned as long as it scatters as a phantom does; patches whose contrast denies that do not count.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import Float32Array, FloatArray, IntArray
from speckle3d.core.curves import SpeckleSize
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import RFSettings, Sweep
from speckle3d.matching.frames import ImageSink
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.patches import PatchGrid

FRAMES = 12
"""Frames looked at, evenly spread over the sweep."""
CONTRAST = (0.75, 1.15)
"""Standard deviation over mean of intensity in patches that count: 1 for speckle, scattered by its 50 to 90
cells. Coherent structure is above; its patches look coarser than speckle."""
LEAST_PATCHES = 8
"""Patches, over all frames, that a row's size is taken from at least."""
NOISE_QUANTILE = 0.2


class SpeckleSizes:
    """Speckle's sizes in the frames that are looked at if none is left out, kept as the sweep is matched.

    Parameters
    ----------
    then : callable, optional
        To which every image is passed on.
    """

    def __init__(self, sweep: Sweep, matcher: FrameMatcher, then: ImageSink | None = None) -> None:
        self._wanted, self._patches, self._then = (
            spread_frames(np.arange(len(sweep)), FRAMES),
            matcher.patches,
            then,
        )
        self.by_frame: dict[int, FloatArray] = {}

    def keep(self, frame: int, intensity: Float32Array) -> None:
        """Take the intensity image of one frame."""
        if frame in self._wanted:
            self.by_frame[frame] = _sizes(intensity, self._patches)
        if self._then:
            self._then(frame, intensity)


def speckle_size(
    sweep: Sweep, matcher: FrameMatcher, among: IntArray | None = None, known: SpeckleSizes | None = None
) -> SpeckleSize:
    """Measure lateral and axial speckle size in each row of the patches that are matched.

    Parameters
    ----------
    among : ndarray of int, optional
        Frames to choose from; by default all.
    known : SpeckleSizes, optional
        Of frames that need not be read anew.

    Returns
    -------
    SpeckleSize
        Of shape (r,); NaN where too few patches hold fully developed speckle.
    """
    frames = spread_frames(np.arange(len(sweep)) if among is None else among, FRAMES)
    found = dict(known.by_frame) if known else {}
    for k in frames:
        if k not in found:
            found[k] = _sizes(matcher.echo(sweep.frames[k]).intensity, matcher.patches)
    sizes = matcher.patches.rows_of(np.stack([found[k] for k in frames]))
    lateral, axial = sizes.transpose(1, 2, 0, 3).reshape(*sizes.shape[1:3], -1)
    return SpeckleSize(_medians(lateral), _medians(axial))


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
    for k in spread_frames(np.arange(len(sweep)), FRAMES):
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


def spread_frames(frames: IntArray, count: int) -> list[int]:
    """Choose at most so many of some frames, evenly spread."""
    at = np.unique(np.linspace(0, frames.size - 1, count).round().astype(int))
    return [int(k) for k in frames[at]]


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
