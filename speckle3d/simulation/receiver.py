"""What a scanner makes of the echoes before it stores them: I/Q, or grey levels of a B-mode image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from scipy import signal as filters

from speckle3d.core.arrays import Complex64Array
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import BModeSettings, Frames, RFSettings, Sweep, read_frame
from speckle3d.simulation.scan import SPECKLE_RMS_COUNTS

_GUARD = 0.1
"""Kept on either side of the band, over its width."""

_WHITE_DB = 20.0
"""Full white over the mean of fully developed speckle."""

_ROOM, _LEAST_ROOM = 1.25, 1.05
"""Sampling rate of I/Q over the width that they keep: by default at least, and the least."""

_WINDOW = ("kaiser", 8.0)
"""Of the low-pass before decimation: what folds into the band is 80 dB down."""
_GREY_DECIMATION = 4
"""Rows of 0.046 mm from RF at 66.7 MHz: 860 in 40 mm."""


@dataclass(frozen=True)
class Demodulator:
    """The analytic signal shifted down and decimated without delay.

    Parameters
    ----------
    rf : RFSettings
        Of the real samples that go in.
    frequency_hz : float
        What they are shifted down by.
    decimation : int, optional
        By default the largest that leaves a quarter more than the band needs.
    """

    rf: RFSettings
    frequency_hz: float
    decimation: int | None = None

    def __post_init__(self) -> None:
        most = int(self.rf.sampling_rate_hz / (_LEAST_ROOM * 2 * self.reach_hz))
        if not 1 <= self.every <= most:
            raise InvalidInputError(
                f"decimation: expected 1 to {most} for the band about {self.frequency_hz:g} Hz, "
                f"got {self.every}"
            )

    @property
    def reach_hz(self) -> float:
        """Highest frequency after mixing that is kept."""
        low, high = self.rf.bandwidth_hz
        return max(high - self.frequency_hz, self.frequency_hz - low) + _GUARD * (high - low)

    @property
    def every(self) -> int:
        """The decimation."""
        if self.decimation is not None:
            return self.decimation
        return max(1, int(self.rf.sampling_rate_hz / (_ROOM * 2 * self.reach_hz)))

    @property
    def signal(self) -> RFSettings:
        """Of the complex samples that come out."""
        rate_hz = self.rf.sampling_rate_hz / self.every
        return replace(self.rf, sampling_rate_hz=rate_hz, demodulation_frequency_hz=self.frequency_hz)

    def samples(self, count: int) -> int:
        """How many come out of so many."""
        return -(-count // self.every)

    def __call__(self, frame: npt.NDArray[Any]) -> Complex64Array:
        """I + iQ of a frame, shape (vector, sample); the echoes' envelope is their magnitude."""
        turns = self.frequency_hz / self.rf.sampling_rate_hz * np.arange(frame.shape[1])
        mixed = filters.hilbert(frame, axis=1) * np.exp(-2j * np.pi * turns)
        kept = filters.resample_poly(mixed, 1, self.every, axis=1, window=_WINDOW)
        return np.asarray(kept, dtype=np.complex64)


@dataclass(frozen=True)
class ReceivedFrames:
    """What is stored of RF frames: I/Q in whole counts of 16 bits, or the log-compressed envelope in 8 bits.

    Parameters
    ----------
    frames : Frames
    demodulate : Demodulator
    dynamic_range_db : float, optional
        From black to white, of an envelope; I/Q without it.
    """

    frames: Frames
    demodulate: Demodulator
    dynamic_range_db: float | None = None
    any_thread: ClassVar[bool] = True
    computed: ClassVar[bool] = True
    stored_dtype: ClassVar[np.dtype[Any]] = np.dtype(np.int16)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Complex, or grey levels."""
        return np.dtype(np.complex64 if self.dynamic_range_db is None else np.uint8)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, vectors, samples."""
        n, vectors, samples = self.frames.shape
        return n, vectors, self.demodulate.samples(samples)

    def __len__(self) -> int:
        return self.frames.shape[0]

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        """One frame, shape (vector, sample)."""
        counts = self.demodulate(read_frame(self.frames, index))
        if self.dynamic_range_db is None:
            limits = np.iinfo(np.int16)
            parts = np.clip(np.rint(counts.view(np.float32)), limits.min, limits.max)
            return parts.view(np.complex64)
        # The envelope's square is twice the RF's.
        over_speckle = np.maximum(np.abs(counts) ** 2 / (2.0 * SPECKLE_RMS_COUNTS**2), 1e-12)
        level = 1.0 + (10.0 * np.log10(over_speckle) - _WHITE_DB) / self.dynamic_range_db
        return np.rint(255.0 * np.clip(level, 0.0, 1.0)).astype(np.uint8)


def received_as_iq(sweep: Sweep, frequency_hz: float | None = None, decimation: int | None = None) -> Sweep:
    """Make an RF sweep one of I/Q.

    Parameters
    ----------
    frequency_hz : float, optional
        What the echoes are shifted down by, by default their centre frequency.
    decimation : int, optional
        See `Demodulator`.

    Raises
    ------
    InvalidInputError
        If the sweep is not RF, or the rate that is left does not hold the band.
    """
    return _received(sweep, frequency_hz, decimation, None)


def received_as_bmode(sweep: Sweep, dynamic_range_db: float, decimation: int | None = None) -> Sweep:
    """Make an RF sweep one of 8-bit B-mode images whose columns are the vectors.

    Raises
    ------
    InvalidInputError
        If the sweep is not RF, or the rows do not hold the band.
    """
    decimation = _GREY_DECIMATION if decimation is None else decimation
    return _received(sweep, None, decimation, dynamic_range_db)


def _received(
    sweep: Sweep, frequency_hz: float | None, decimation: int | None, dynamic_range_db: float | None
) -> Sweep:
    rf, grid = sweep.signal, sweep.grid
    if not isinstance(rf, RFSettings) or rf.are_complex:
        raise InvalidInputError(f"{sweep.name}: expected RF, got samples of another kind")
    made = Demodulator(rf, rf.centre_frequency_hz if frequency_hz is None else frequency_hz, decimation)
    spacing_mm = made.signal.sample_spacing_mm
    return replace(
        sweep,
        frames=ReceivedFrames(sweep.frames, made, dynamic_range_db),
        grid=replace(grid, samples=made.samples(grid.samples), sample_spacing_mm=spacing_mm),
        signal=made.signal if dynamic_range_db is None else BModeSettings(dynamic_range_db),
    )
