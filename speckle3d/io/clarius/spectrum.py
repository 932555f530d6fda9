"""The band of echoes, measured in a recording whose files do not give it.

Neighbouring lines see much of the same echoes but not the same noise: the mean of their cross-spectra, by
Welch's method, of lines scaled to the same power at all depths, is that of the echoes alone, whatever the
noise's. The band is where it is above a quarter of its highest (-6 dB), about the transmit frequency. It is
the band of the echoes at all depths together, lower than the probe's in tissue that attenuates. On simulated
RF and I/Q the edges move by 0.1 MHz from 40 to 0 dB over noise.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.sweep import Frames

_RESOLUTION_HZ = 0.5e6
"""A tenth of a narrow probe's band."""

_STEP_HZ = 0.1e6
"""Edges are rounded: they are known no better, and are to be typed where other recordings need the same."""

_CLEAR = 10.0
"""Least height of the band, in standard deviations of the mean cross-spectrum of as many spectra of noise
alone: a quarter of it, where the edges are, is then 2.5 of them."""


def band_hz(
    frames: Frames, sampling_rate_hz: float, transmit_hz: float, shift_hz: float | None = None
) -> tuple[float, float] | None:
    """Lowest and highest frequency of the -6 dB band of echoes; None where there is no clear band.

    Parameters
    ----------
    frames : Frames
        RF, or I/Q (complex).
    transmit_hz : float
        The spectrum's highest lies within a factor of two of it.
    shift_hz : float, optional
        Frequency that I/Q were shifted down by; None for RF.
    """
    length = max(2 ** round(np.log2(sampling_rate_hz / _RESOLUTION_HZ)), 16)
    count, vectors, samples = frames.shape
    if vectors < 2 or samples < length:
        return None
    chosen = sorted({0, count // 2, count - 1})
    shared, power = np.zeros(length), np.zeros(length)
    for i in chosen:
        lines = frames[i] - (frames[i].mean(axis=1, keepdims=True) if shift_hz is None else 0.0)
        pieces = np.lib.stride_tricks.sliding_window_view(lines, length, axis=1)[:, :: length // 2]
        level = np.sqrt(np.mean(np.abs(pieces) ** 2, axis=(0, 2), keepdims=True))
        spectra = np.fft.fftshift(np.fft.fft(pieces / (level + (level == 0)) * np.hanning(length)), axes=-1)
        shared += (spectra[:-1].conj() * spectra[1:]).real.mean(axis=(0, 1))
        power += (np.abs(spectra) ** 2).mean(axis=(0, 1))
    frequency = np.fft.fftshift(np.fft.fftfreq(length, 1 / sampling_rate_hz)) + (shift_hz or 0.0)
    near = np.flatnonzero((frequency > 0.5 * transmit_hz) & (frequency < 2 * transmit_hz))
    if not near.size:
        return None
    top = int(near[np.argmax(shared[near])])
    level = shared[top] / 4
    left, right = np.flatnonzero(shared[:top] < level), np.flatnonzero(shared[top:] < level) + top
    if shared[top] <= _CLEAR / np.sqrt(pieces[1:, :, 0].size * len(chosen)) * power[top] or not (
        left.size and right.size
    ):
        return None
    rise, fall = slice(left[-1], left[-1] + 2), slice(right[0], right[0] - 2, -1)
    edges = (np.interp(level, shared[edge], frequency[edge]) for edge in (rise, fall))
    low, high = (_STEP_HZ * round(float(edge) / _STEP_HZ) for edge in edges)
    return (low, high) if low > 0 else None
