"""The band of echoes, measured in a recording whose files do not give it.

Neighbouring lines see much of the same echoes but not the same noise: the mean of their cross-spectra, of
lines scaled to the same power at all depths, is that of the echoes alone, whatever the noise's. The band is
where it is above a quarter of its highest (-6 dB), about the transmit frequency. It is the band of the echoes
at all depths together, lower than the probe's in tissue that attenuates. On simulated RF and I/Q the edges
move by 0.1 MHz from 40 to 0 dB over noise.
"""

import numpy as np
from scipy.ndimage import uniform_filter1d

from speckle3d.core.sweep import Frames

_RESOLUTION_HZ = 0.5e6
"""A tenth of a narrow probe's band."""

_STEP_HZ = 0.1e6
"""Edges are rounded: they are known no better, and are to be typed where other recordings need the same."""

_CLEAR = 10.0
"""Least share of the power that neighbouring lines have in common, in standard deviations of that of noise
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
    count, vectors, samples = frames.shape
    width = max(round(_RESOLUTION_HZ * samples / sampling_rate_hz), 1)
    common, power, numbers = np.zeros(samples), np.zeros(samples), {0, count // 2, count - 1}
    for i in numbers:
        lines = 1.0 * frames[i]
        level = np.sqrt(uniform_filter1d(np.mean(np.abs(lines) ** 2, axis=0), samples // width))
        spectra = np.fft.fft(lines / (level + (level == 0)))
        common += (spectra[:-1].conj() * spectra[1:]).real.sum(axis=0)
        power += (np.abs(spectra) ** 2).sum(axis=0)
    frequency = np.fft.fftshift(np.fft.fftfreq(samples, 1 / sampling_rate_hz)) + (shift_hz or 0.0)
    common, power = (uniform_filter1d(np.fft.fftshift(of), width, mode="wrap") for of in (common, power))
    near = (frequency > 0.5 * transmit_hz) & (frequency < 2 * transmit_hz)
    top = int(np.argmax(np.where(near, common, -np.inf)))
    outside = np.flatnonzero(common < common[top] / 4)
    sides = outside[outside < top][-1:], outside[outside > top][:1]
    least = _CLEAR / np.sqrt(max(len(numbers) * (vectors - 1) * width, 1)) * power[top]
    if not near[top] or not all(side.size for side in sides) or common[top] <= least:
        return None
    low, high = (_STEP_HZ * round(float(frequency[side[0]]) / _STEP_HZ) for side in sides)
    return (low, high) if low > 0 else None
