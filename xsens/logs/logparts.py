"""What every reader of logs shares: what it may be told beside the log, and how parts become an `ImuLog`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps, Timeline, timeline
from xsens.logs.samples import ImuLog
from xsens.logs.worlds import Orientations
from xsens.messages.mtdata import DataLayout
from xsens.messages.rawcounts import RawCalibration

TRANSPOSED = "matrices were taken by columns: so they turn gravity upright"

_ABSURD = 1e6
"""Larger values, in any of the units, are damage: the sensors' ranges end at 160 m/s² and 35 rad/s."""


@dataclass(frozen=True)
class Hints:
    """What is known beside the log; it outweighs what the log says.

    Attributes
    ----------
    rate_hz : float, optional
        Samples per second, where there is a counter but no clock.
    layout : DataLayout, optional
        Of legacy data messages without their configuration.
    calibration : RawCalibration, optional
        Of raw counts without their calibration block, from another log of the same unit.
    world : str, optional
        Of the sensor's own orientation, ENU, NED or NWU, where the log does not say.
    unit : int, optional
        Which of several units behind a master, from 0.

    Raises
    ------
    InvalidInputError
        If the rate is not positive.
    """

    rate_hz: float | None = None
    layout: DataLayout | None = None
    calibration: RawCalibration | None = None
    world: str | None = None
    unit: int | None = None

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0.0 < self.rate_hz < float("inf"):
            raise InvalidInputError(f"rate_hz: expected a number above 0, got {self.rate_hz:g}")


@dataclass(frozen=True)
class Parts:
    """Samples before their clock is known: as in `ImuLog`, one row for each message or line."""

    source: str
    notes: tuple[str, ...] = ()
    accelerometer_m_s2: FloatArray | None = None
    gyroscope_rad_s: FloatArray | None = None
    magnetometer_au: FloatArray | None = None
    orientations: Orientations | None = None

    def noting(self, *notes: str) -> Parts:
        """The same with more notes."""
        return replace(self, notes=(*self.notes, *notes))


def on_clock(stamps: Stamps, samples: int, parts: Parts, hints: Hints) -> ImuLog:
    """The log of samples that may have a clock, or a counter and a rate, or a rate alone.

    Raises
    ------
    InvalidInputError
        If they have none of these.
    """
    if hints.rate_hz is not None:
        stamps = replace(stamps, period_s=1.0 / hints.rate_hz)
    if stamps.counter is not None or stamps.ticks is not None:
        return assembled(timeline(stamps), parts)
    if hints.rate_hz is None:
        raise InvalidInputError("expected samples with a clock or a counter, or a sampling rate, got neither")
    uncounted = replace(stamps, counter=np.arange(samples))
    note = "samples have no counter: losses cannot be found"
    return replace(assembled(timeline(uncounted), parts.noting(note)), counter=None)


def assembled(line: Timeline, parts: Parts) -> ImuLog:
    """The log of the samples that the timeline keeps."""
    turned = parts.orientations
    missing = 0 if turned is None else int((~turned.there).sum())
    lacking = (f"{missing} samples lack the sensor's own orientation",) if missing else ()
    return ImuLog(
        line.time_s,
        _sane(parts.accelerometer_m_s2, line.kept),
        _sane(parts.gyroscope_rad_s, line.kept),
        _sane(parts.magnetometer_au, line.kept),
        None if turned is None or not turned.there.any() else _kept(turned.world_from_sensor, line.kept),
        line.counter,
        line.gaps,
        (*parts.notes, *_out_of_range(parts, line.kept), *lacking, *line.notes),
        parts.source,
        np.zeros(0, dtype=bool) if turned is None or not turned.there.any() else turned.there[line.kept],
    )


def _kept(rotations: Rotation, kept: BoolArray) -> Rotation:
    return rotations if kept.all() else rotations[kept]


def _out_of_range(parts: Parts, kept: BoolArray) -> tuple[str, ...]:
    """What `_sane` leaves out, for other reasons than that it was missing."""
    notes = []
    for name in ("accelerometer", "gyroscope", "magnetometer"):
        vectors = next(value for key, value in vars(parts).items() if key.startswith(name))
        if vectors is not None and (count := int((np.abs(vectors[kept]) >= _ABSURD).any(axis=1).sum())):
            notes.append(f"{count} {name} readings out of range were left out")
    return tuple(notes)


def _sane(vectors: FloatArray | None, kept: BoolArray) -> FloatArray | None:
    """Kept rows, NaN where they cannot be a measurement; None if all are."""
    if vectors is None:
        return None
    rows = vectors if kept.all() else vectors[kept]
    if np.abs(rows).max() < _ABSURD:  # never so with a NaN
        return rows
    good = np.asarray((np.abs(rows) < _ABSURD).all(axis=1))
    return np.where(good[:, None], rows, np.nan) if good.any() else None
