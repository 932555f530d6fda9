"""The band of echoes, measured in a recording whose files do not give it.

Neighbouring lines see much of the same echoes but not the same noise: the mean of their cross-spectrum, over
segments along the lines that are each scaled to the same power, is that of the echoes alone, whatever the
noise's. The band is where it is above a quarter of its highest (-6 dB), about the transmit frequency. It is
the band of the echoes at all depths together, lower than the probe's in tissue that attenuates. On simulated
RF and I/Q the edges move by 0.1 MHz from 40 to 0 dB over noise; at -10 dB no band is found.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import Frames

_PAIRS = 48
_RESOLUTION_HZ = 0.5e6
"""A tenth of a narrow probe's band."""

_STEP_HZ = 0.1e6
"""Edges are rounded: they are known no better, and are to be typed where other recordings need the same."""

_CLEAR = 10.0
"""Least height of the band, in standard deviations of the mean cross-spectrum of as many spectra of noise
alone: a quarter of it, where the edges are, is then 2.5 of them."""


@dataclass(frozen=True)
class Echoes:
    """Spectrum of a recording's echoes.

    Attributes
    ----------
    frames : Frames
        RF, or I/Q (complex).
    transmit_hz : float
        The spectrum's highest lies within a factor of two of it.
    shift_hz : float, optional
        Frequency that I/Q were shifted down by; None for RF.
    """

    frames: Frames
    sampling_rate_hz: float
    transmit_hz: float
    shift_hz: float | None = None

    @cached_property
    def band_hz(self) -> tuple[float, float] | None:
        """Lowest and highest frequency of the -6 dB band; None where there is no clear band."""
        spectrum = self._shared(0.0, 1.0)
        if spectrum is None:
            return None
        frequency, power, top = spectrum
        level = power[top] / 4
        left, right = np.flatnonzero(power[:top] < level), np.flatnonzero(power[top:] < level) + top
        if not (left.size and right.size):
            return None
        rise, fall = slice(left[-1], left[-1] + 2), slice(right[0], right[0] - 2, -1)
        edges = (np.interp(level, power[edge], frequency[edge]) for edge in (rise, fall))
        low, high = (_STEP_HZ * round(float(edge) / _STEP_HZ) for edge in edges)
        return (low, high) if low > 0 else None

    @cached_property
    def centres_hz(self) -> tuple[float, float] | None:
        """Centre of the spectrum in the nearest and in the farthest third of the lines; None if not clear.

        Tissue lowers it with depth. In I/Q that carry the other sign of Q, or were shifted down otherwise
        than is said, it may rise.
        """
        centres = []
        for begin, end in ((0.0, 1 / 3), (2 / 3, 1.0)):
            spectrum = self._shared(begin, end)
            if spectrum is None:
                return None
            frequency, power, top = spectrum
            heard = np.where(power > power[top] / 4, power, 0.0)
            centres.append(float(np.sum(heard * frequency) / np.sum(heard)))
        return centres[0], centres[1]

    def _shared(self, begin: float, end: float) -> tuple[FloatArray, FloatArray, int] | None:
        """Frequencies, what neighbouring lines share of each, and where that is highest; None if not clear.

        Parameters
        ----------
        begin, end : float
            Part of the lines' length.
        """
        length = max(2 ** round(np.log2(self.sampling_rate_hz / _RESOLUTION_HZ)), 16)
        count, vectors, samples = self.frames.shape
        window = np.hanning(length + 1)[:-1]
        shared, power, spectra = np.zeros(length), np.zeros(length), 0
        first = np.unique(np.linspace(0, vectors - 2, _PAIRS if vectors > 1 else 0).astype(int))
        for i in sorted({0, count // 2, count - 1}):
            frame = self.frames[i]
            for start in range(round(begin * samples), round(end * samples) - length + 1, length // 2):
                part = slice(start, start + length)
                pair = [_spectrum(frame[lines, part], window) for lines in (first, first + 1)]
                scale = np.sqrt([np.sum(np.abs(lines) ** 2, axis=1) for lines in pair]).prod(axis=0)
                used = scale > 0
                one, other = (lines[used] / np.sqrt(scale[used, None]) for lines in pair)
                shared += (one * other.conj()).real.sum(axis=0)
                power += 0.5 * (np.abs(one) ** 2 + np.abs(other) ** 2).sum(axis=0)
                spectra += int(np.count_nonzero(used))
        frequency = np.fft.fftfreq(length, 1 / self.sampling_rate_hz).astype(np.float64)
        frequency += self.shift_hz or 0.0
        # Real samples have each frequency twice.
        order = np.argsort(frequency[: length // 2] if self.shift_hz is None else frequency)
        frequency, shared, power = frequency[order], shared[order], power[order]
        near = (frequency > 0.5 * self.transmit_hz) & (frequency < 2 * self.transmit_hz)
        if not near.any() or spectra == 0:
            return None
        top = int(np.flatnonzero(near)[np.argmax(shared[near])])
        return (frequency, shared, top) if shared[top] >= _CLEAR / np.sqrt(spectra) * power[top] else None


def _spectrum(part: np.ndarray, window: FloatArray) -> np.ndarray:
    """Spectra of a segment of some lines; what is constant in RF, of the electronics, is left out."""
    plain = part if np.iscomplexobj(part) else part - part.mean(axis=1, keepdims=True)
    return np.asarray(np.fft.fft(plain * window, axis=1))
