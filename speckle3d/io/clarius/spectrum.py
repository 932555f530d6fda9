"""The band of echoes, measured in a recording whose files do not give it.

The mean power spectrum of segments along lines, each scaled to the same power, less its floor (noise), is
above a quarter of its highest (-6 dB) in one band about the transmit frequency; or else no band is found.
"""

from __future__ import annotations

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import Frames

_FRAMES = 3
_LINES = 64
_SEGMENT = 128
"""Samples: 0.47 MHz at 60 MHz, a tenth of a narrow probe's band."""

_LEAST_SPECTRA = 200
"""The mean of so many is known to 7 %, 0.3 dB."""

_LEAST_CONTRAST = 10.0
"""Highest over floor: white noise alone has 1.3, a band under noise of 0.1 of its highest is not clear."""


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
    spectrum = _mean_spectrum(frames)
    if spectrum is None:
        return None
    size, (middle, rate) = spectrum.size, (shifted_by_hz or 0.0, sampling_rate_hz)
    frequency = np.fft.fftshift(np.fft.fftfreq(size, 1 / rate)) + middle
    power = np.fft.fftshift(spectrum)
    if shifted_by_hz is None:
        power, frequency = power[size // 2 :], frequency[size // 2 :]
    floor = float(np.mean(np.sort(power)[: max(power.size // 8, 1)]))
    return _band(power - floor, frequency, about_hz, floor)


def _band(
    power: FloatArray, frequency: FloatArray, about_hz: float, floor: float
) -> tuple[float, float] | None:
    near = (frequency > 0.5 * about_hz) & (frequency < 2 * about_hz)
    if not near.any():
        return None
    top = int(np.flatnonzero(near)[np.argmax(power[near])])
    if power[top] < _LEAST_CONTRAST * floor:
        return None
    level = power[top] / 4
    below = power < level
    left, right = np.flatnonzero(below[:top]), np.flatnonzero(below[top:]) + top
    if not (left.size and right.size):
        return None
    rise, fall = slice(left[-1], left[-1] + 2), slice(right[0], right[0] - 2, -1)
    low, high = (np.interp(level, power[edge], frequency[edge]) for edge in (rise, fall))
    return (float(low), float(high)) if 0 < low < about_hz * 1.5 and high > about_hz / 1.5 else None


def _mean_spectrum(frames: Frames) -> FloatArray | None:
    """Mean of segments' power spectra, each of sum one; None where there are too few."""
    count, vectors, samples = frames.shape
    if samples < _SEGMENT:
        return None
    window = np.hanning(_SEGMENT + 1)[:-1]
    total, spectra = np.zeros(_SEGMENT), 0
    for i in sorted({0, count // 2, count - 1})[:_FRAMES]:
        chosen = np.unique(np.linspace(0, vectors - 1, _LINES).astype(int))
        frame = frames[i][chosen]
        for start in range(0, samples - _SEGMENT + 1, _SEGMENT // 2):
            part = frame[:, start : start + _SEGMENT]
            if not np.iscomplexobj(part):
                part = part - part.mean(axis=1, keepdims=True)
            power = np.abs(np.fft.fft(part * window, axis=1)) ** 2
            sums = power.sum(axis=1)
            total += (power[sums > 0] / sums[sums > 0, None]).sum(axis=0)
            spectra += int(np.count_nonzero(sums))
    return total / spectra if spectra >= _LEAST_SPECTRA else None
