"""Power spectrum of a sweep's echoes, within the band that is matched, by row of patches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.curves import EchoSpectra
from speckle3d.core.sweep import RFSettings, Sweep, read_frame
from speckle3d.core.threads import ahead
from speckle3d.matching.matcher import FrameMatcher

FRAMES = 16
"""Frames looked at, evenly spread: one in each 0.5 mm of 8 mm; nearer ones see the same speckle."""
PHANTOM_FRAMES = 48
"""The same of a phantom's sweep, whose spectrum serves many others."""


def row_spectra(
    sweep: Sweep, matcher: FrameMatcher, among: IntArray | None = None, most: int = FRAMES
) -> EchoSpectra | None:
    """Power spectrum at each row of patches, from some frames, which are read anew one after another.

    RF and I/Q of one sweep have the same: both are band-passed and resampled alike before they are matched.
    Every patch counts the same, however bright.

    Parameters
    ----------
    among : ndarray of int, optional
        Frames to choose from; by default all.
    most : int
        Frames to look at.

    Returns
    -------
    EchoSpectra or None
        None if the sweep holds B-mode images, or none of the frames are to be used.
    """
    signal = sweep.signal
    frames = np.arange(len(sweep)) if among is None else among
    if not isinstance(signal, RFSettings) or not frames.size:
        return None
    frames = frames[np.unique(np.linspace(0, frames.size - 1, most).round().astype(int))]

    def spectrum(frame: int) -> FloatArray:
        return _of_frame(read_frame(sweep.frames, frame), matcher)

    by_patch = np.mean(list(ahead(spectrum, frames.tolist())), axis=0)
    patches = matcher.patches
    count = int(patches.size[1])
    rate_hz = 1e3 * signal.speed_of_sound_m_s / (2.0 * patches.spacing_mm[1])
    # The band's centre was shifted to zero.
    frequency = fft.fftfreq(count, 1.0 / rate_hz) + np.mean(signal.bandwidth_hz)
    low, high = signal.bandwidth_hz
    edge = matcher.key.edge_fraction * (high - low)
    rising = np.argsort(frequency)
    kept = rising[(frequency[rising] > low - edge) & (frequency[rising] < high + edge)]
    power = patches.rows_of(by_patch.T).mean(axis=-1).T
    return EchoSpectra(patches.row_depth_mm, frequency[kept], power[:, kept])


def mean_spectra(spectra: Sequence[EchoSpectra]) -> EchoSpectra | None:
    """Mean of some sweeps' spectra at the depths of the first; None of none."""
    if not spectra:
        return None
    first = spectra[0]
    power = np.mean([each.at(first.depth_mm, first.frequency_hz) for each in spectra], axis=0)
    return EchoSpectra(first.depth_mm, first.frequency_hz, power)


def _of_frame(frame: FloatArray, matcher: FrameMatcher) -> FloatArray:
    """Power spectrum of each patch of one frame, of unit sum, shape (p, f)."""
    echo, (wide, high) = matcher.extractor.analytic(frame), matcher.patches.size
    tiles = np.stack([echo[v : v + wide, s : s + high] for v, s in matcher.patches.first])
    spectrum = fft.fft(tiles * np.hanning(high).astype(np.float32), axis=-1)
    power = (spectrum.real**2 + spectrum.imag**2).sum(axis=1, dtype=float)
    return np.asarray(power / np.maximum(power.sum(axis=1, keepdims=True), 1e-30))
