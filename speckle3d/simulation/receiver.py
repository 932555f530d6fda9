"""Receiver of a scanner: RF to I/Q, or to grey levels of a B-mode image."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from speckle3d.core.arrays import AnyArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, Frames, RFSettings, Sweep
from speckle3d.simulation.scan import SPECKLE_RMS_COUNTS

_WHITE_DB = 20.0
"""Full white over the mean of fully developed speckle."""

_LEAST_RATE, _USUAL_RATE = 1.33, 1.5
"""Sampling rate of I/Q over the width of their band: what the low-pass lets fold into it, and by default."""

_WINDOW = ("kaiser", 8.0)
"""Of the low-pass before decimation, 80 dB down at five quarters of its cut-off."""
_GREY_DECIMATION = 4
"""Rows of 0.046 mm from RF at 66.7 MHz: 860 in 40 mm."""


@dataclass(frozen=True)
class ReceivedFrames:
    """Frames received from RF: 16-bit I/Q, or the 8-bit log-compressed envelope.

    Parameters
    ----------
    frames : Frames
        Real echoes, whose analytic signal is shifted down and decimated without delay.
    cycles_per_sample : float
        What they are shifted down by.
    decimation : int
    dynamic_range_db : float, optional
        From black to white, of an envelope; I/Q without it.
    """

    frames: Frames
    cycles_per_sample: float
    decimation: int
    dynamic_range_db: float | None = None
    any_thread = computed = True
    stored_dtype = np.dtype(np.int16)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Complex, or grey levels."""
        return np.dtype(np.complex64 if self.dynamic_range_db is None else np.uint8)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, vectors, samples."""
        n, vectors, samples = self.frames.shape
        return n, vectors, -(-samples // self.decimation)

    def __getitem__(self, index: int) -> AnyArray:
        """One frame, shape (vector, sample)."""
        from scipy import signal as filters  # RF has no need of it, and it takes half a second

        echoes = filters.hilbert(self.frames[index], axis=1)
        baseband = echoes * np.exp(-2j * np.pi * self.cycles_per_sample * np.arange(echoes.shape[1]))
        counts = filters.resample_poly(baseband, 1, self.decimation, axis=1, window=_WINDOW)
        if self.dynamic_range_db is None:
            parts = np.clip(np.rint(counts.view(np.float64)), -(2**15), 2**15 - 1)
            return parts.view(np.complex128).astype(np.complex64)
        # The envelope's square is twice the RF's.
        over_speckle = np.maximum(np.abs(counts) ** 2 / (2.0 * SPECKLE_RMS_COUNTS**2), 1e-12)
        level = 1.0 + (10.0 * np.log10(over_speckle) - _WHITE_DB) / self.dynamic_range_db
        return np.rint(255.0 * np.clip(level, 0.0, 1.0)).astype(np.uint8)


def received(
    sweep: Sweep,
    dynamic_range_db: float | None = None,
    frequency_hz: float | None = None,
    decimation: int | None = None,
) -> Sweep:
    """Make an RF sweep one of I/Q, or with a dynamic range one of 8-bit B-mode whose columns are the vectors.

    Parameters
    ----------
    dynamic_range_db : float, optional
        Of B-mode, from black to white.
    frequency_hz : float, optional
        What the echoes are shifted down by, by default their centre frequency.
    decimation : int, optional
        By default 4 of B-mode, and of I/Q the largest that leaves half more than the band needs.

    Raises
    ------
    InvalidInputError
        If echoes would fold into the band.
    """
    rf = sweep.signal
    assert isinstance(rf, RFSettings)
    (low, high), rate_hz = rf.bandwidth_hz, rf.sampling_rate_hz
    frequency_hz = frequency_hz or rf.centre_frequency_hz
    most = rate_hz / (2 * max(high - frequency_hz, frequency_hz - low))
    usual = max(1, int(most / _USUAL_RATE)) if dynamic_range_db is None else _GREY_DECIMATION
    every = decimation or usual
    if every > most / _LEAST_RATE:
        raise InvalidInputError(
            f"decimation: expected at most {int(most / _LEAST_RATE)}, so that nothing folds into the band, "
            f"got {every}"
        )
    signal = replace(rf, sampling_rate_hz=rate_hz / every, demodulation_frequency_hz=frequency_hz)
    frames = ReceivedFrames(sweep.frames, frequency_hz / rate_hz, every, dynamic_range_db)
    return replace(
        sweep,
        frames=frames,
        grid=replace(sweep.grid, samples=frames.shape[2], sample_spacing_mm=signal.sample_spacing_mm),
        signal=signal if dynamic_range_db is None else BModeSettings(dynamic_range_db),
    )
