"""The band of echoes, measured in a recording whose files do not give it.

Neighbouring lines see much of the same echoes but not the same noise: the mean of their cross-spectrum, over
segments along the lines that are each scaled to the same power, is that of the echoes alone, whatever the
noise's. The band is where it is above a quarter of its highest (-6 dB), about the transmit frequency. It is
the band of the echoes at all depths together, lower than the probe's in tissue that attenuates. On simulated
RF and I/Q the edges move by 0.1 MHz from 40 to 0 dB over noise; at -10 dB no band is found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import Frames

_FRAMES = 3
_PAIRS = 48
_RESOLUTION_HZ = 0.5e6
"""A tenth of a narrow probe's band."""

_STEP_HZ = 0.1e6
"""Edges are rounded: they are known no better, and are to be typed where other recordings need the same."""

_CLEAR = 10.0
"""Least height of the band, in standard deviations of the mean cross-spectrum of as many spectra of noise
alone: a quarter of it, where the edges are, is then 2.5 of them."""


@dataclass(frozen=True)
class _Shared:
    """What neighbouring lines share of each frequency, and their power, means of so many spectra."""

    frequency_hz: FloatArray
    shared: FloatArray
    power: FloatArray
    spectra: int

    def top(self, about_hz: float) -> int | None:
        """Index of the highest within a factor of two of a frequency; None where it is not clear."""
        near = (self.frequency_hz > 0.5 * about_hz) & (self.frequency_hz < 2 * about_hz)
        if not near.any() or self.spectra == 0:
            return None
        top = int(np.flatnonzero(near)[np.argmax(self.shared[near])])
        return top if self.shared[top] >= _CLEAR / np.sqrt(self.spectra) * self.power[top] else None


def measured_band_hz(
    frames: Frames, sampling_rate_hz: float, about_hz: float, shifted_by_hz: float | None
) -> tuple[float, float] | None:
    """Measure the -6 dB band of a recording's echoes.

    Parameters
    ----------
    frames : Frames
        RF, or I/Q (complex).
    about_hz : float
        Transmit frequency: the band's highest lies within a factor of two of it.
    shifted_by_hz : float, optional
        Frequency that I/Q were shifted down by; None for RF.

    Returns
    -------
    tuple of float, or None
        Lowest and highest frequency; None where there is no clear band.
    """
    found = _shared(frames, sampling_rate_hz, shifted_by_hz, (0.0, 1.0))
    top = found.top(about_hz)
    return None if top is None else _edges(found.shared, found.frequency_hz, top)


def measured_centres_hz(
    frames: Frames, sampling_rate_hz: float, about_hz: float, shifted_by_hz: float | None
) -> tuple[float, float] | None:
    """Measure the centre of the echoes' spectrum in the nearest and in the farthest third of the lines.

    Tissue lowers it with depth. In I/Q that carry the other sign of Q, or were shifted down otherwise than is
    said, it may rise.

    Returns
    -------
    tuple of float, or None
        None where one of them is not clear.
    """
    centres = []
    for span in ((0.0, 1 / 3), (2 / 3, 1.0)):
        found = _shared(frames, sampling_rate_hz, shifted_by_hz, span)
        top = found.top(about_hz)
        if top is None:
            return None
        heard = np.where(found.shared > found.shared[top] / 4, found.shared, 0.0)
        centres.append(float(np.sum(heard * found.frequency_hz) / np.sum(heard)))
    return centres[0], centres[1]


def _edges(power: FloatArray, frequency: FloatArray, top: int) -> tuple[float, float] | None:
    """Frequencies beside the highest at which the power has fallen to a quarter; None where it does not."""
    level = power[top] / 4
    left, right = np.flatnonzero(power[:top] < level), np.flatnonzero(power[top:] < level) + top
    if not (left.size and right.size):
        return None
    rise, fall = slice(left[-1], left[-1] + 2), slice(right[0], right[0] - 2, -1)
    low, high = (float(np.interp(level, power[edge], frequency[edge])) for edge in (rise, fall))
    low, high = (_STEP_HZ * round(edge / _STEP_HZ) for edge in (low, high))
    return (low, high) if low > 0 else None


def _shared(
    frames: Frames, sampling_rate_hz: float, shifted_by_hz: float | None, span: tuple[float, float]
) -> _Shared:
    """Compare neighbouring lines within a part of their length."""
    length = max(2 ** round(np.log2(sampling_rate_hz / _RESOLUTION_HZ)), 16)
    count, vectors, samples = frames.shape
    begin, end = (round(part * samples) for part in span)
    window = np.hanning(length + 1)[:-1]
    shared, power, spectra = np.zeros(length), np.zeros(length), 0
    first = np.unique(np.linspace(0, vectors - 2, _PAIRS if vectors > 1 else 0).astype(int))
    for i in sorted({0, count // 2, count - 1})[:_FRAMES]:
        frame = frames[i]
        for start in range(begin, end - length + 1, length // 2):
            pair = [_spectrum(frame[lines, start : start + length], window) for lines in (first, first + 1)]
            scale = np.sqrt([np.sum(np.abs(each) ** 2, axis=1) for each in pair]).prod(axis=0)
            used = scale > 0
            one, other = (each[used] / np.sqrt(scale[used, None]) for each in pair)
            shared += (one * other.conj()).real.sum(axis=0)
            power += 0.5 * (np.abs(one) ** 2 + np.abs(other) ** 2).sum(axis=0)
            spectra += int(np.count_nonzero(used))
    frequency = np.fft.fftfreq(length, 1 / sampling_rate_hz) + (shifted_by_hz or 0.0)
    # Real samples have each frequency twice.
    kept = slice(0, length // 2) if shifted_by_hz is None else slice(None)
    order = np.argsort(frequency[kept])
    shared, power = (each[kept][order] / max(spectra, 1) for each in (shared, power))
    return _Shared(np.asarray(frequency[kept][order]), shared, power, spectra)


def _spectrum(part: np.ndarray, window: FloatArray) -> np.ndarray:
    """Spectra of a segment of some lines; what is constant in RF, of the electronics, is left out."""
    plain = part if np.iscomplexobj(part) else part - part.mean(axis=1, keepdims=True)
    return np.asarray(np.fft.fft(plain * window, axis=1))
