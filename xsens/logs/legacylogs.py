"""Samples from legacy data messages: raw counts with a calibration block, or what the configuration says."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps
from xsens.logs.logparts import TRANSPOSED, Hints, Parts, on_clock
from xsens.logs.samples import ImuLog
from xsens.logs.worlds import Orientations, from_angles, from_matrices, from_quaternions, rows_or_columns
from xsens.messages.catalogue import Configuration, MessageId, UnitConfiguration
from xsens.messages.framing import Frames
from xsens.messages.mtdata import DataLayout, OutputMode, OutputSettings, Values
from xsens.messages.rawcounts import BLOCK_SIZE, NOT_COMPENSATED, RawCalibration

_RAW = OutputMode.RAW | OutputMode.MT9
_RAW_WITH_COUNTER = 22
_ENOUGH = 10_000
"""Messages that show where the counter is."""


@dataclass(frozen=True)
class _Slice:
    """One unit's part of every payload: its layout, the payload's size, and which bytes (None: all)."""

    layout: DataLayout
    size: int
    columns: IntArray | None = None

    def of(self, frames: Frames) -> Values:
        payloads = frames.payloads()
        return self.layout.decode(payloads if self.columns is None else payloads[:, self.columns])


def legacy_log(frames: Frames, which: IntArray, stamps: Stamps, parts: Parts, hints: Hints) -> ImuLog:
    """Samples of the MTData messages `which`.

    Raises
    ------
    InvalidInputError
        If layout, rate or calibration is neither in the log nor in the hints.
    """
    configuration, calibration = _configuration(frames), hints.calibration or _calibration(frames)
    data = frames[which]
    part = _slice(data, configuration, hints)
    fits = data.payload_size == part.size
    if not fits.any():
        raise InvalidInputError(f"expected data messages of {part.size} bytes, as configured, got none")
    if not fits.all():
        parts = parts.noting(f"{(~fits).sum()} data messages were not as long as configured: left out")
    values = part.of(data if fits.all() else data[fits])
    raw = part.layout.mode & _RAW
    parts = _in_units(values, calibration, parts) if raw else _as_sent(values, parts, part.layout, hints)
    stamps = replace(stamps, starts=_kept(stamps.starts, fits), computer_s=_kept(stamps.computer_s, fits))
    counter = values["counter"][:, 0].astype(np.int64) if "counter" in values else None
    rate_hz = hints.rate_hz or _rate_hz(configuration, calibration)
    return on_clock(replace(stamps, counter=counter), int(fits.sum()), parts, replace(hints, rate_hz=rate_hz))


def _kept(values: Any, kept: BoolArray) -> Any:
    return None if values is None else values[kept]


def _configuration(frames: Frames) -> Configuration | None:
    """The last one that can be read."""
    for i in np.flatnonzero(frames.mid == MessageId.CONFIGURATION)[::-1].tolist():
        with suppress(InvalidInputError):
            return Configuration.from_message(frames.message(i))
    return None


def _calibration(frames: Frames) -> RawCalibration | None:
    """The last calibration block that can be read."""
    blocks = (frames.mid == MessageId.EMTS) & (frames.payload_size == BLOCK_SIZE)
    for i in np.flatnonzero(blocks)[::-1].tolist():
        with suppress(InvalidInputError):
            return RawCalibration.from_message(frames.message(i))
    return None


def _slice(data: Frames, configuration: Configuration | None, hints: Hints) -> _Slice:
    if hints.layout is not None:
        return _Slice(hints.layout, hints.layout.size)
    units = configuration.units if configuration is not None else ()
    if len(units) > 1:
        return _of_unit(units, hints.unit)
    if units and not units[0].output_mode & _RAW:
        layout = DataLayout(units[0].output_mode, units[0].output_settings)
        return _Slice(layout, layout.size)
    return _raw(data)


def _of_unit(units: tuple[UnitConfiguration, ...], unit: int | None) -> _Slice:
    """Behind a master: its counter, then each unit's data."""
    if unit is None or not 0 <= unit < len(units):
        names = ", ".join(f"{u.device_id:08X}" for u in units)
        raise InvalidInputError(f"expected a choice among {len(units)} units (unit 0 is first: {names})")
    chosen, sizes = units[unit], [u.data_length for u in units]
    settings = chosen.output_settings | OutputSettings.COUNTER
    layout = DataLayout(chosen.output_mode, settings, counter_first=True)
    first = 2 + sum(sizes[:unit])
    if layout.size != 2 + sizes[unit]:
        raise InvalidInputError(
            f"unit {unit}: expected {layout.size - 2} bytes by its output mode, got {sizes[unit]} configured"
        )
    columns = np.concatenate(([0, 1], np.arange(first, first + sizes[unit])))
    return _Slice(layout, 2 + sum(sizes), columns)


def _raw(data: Frames) -> _Slice:
    """Raw counts: with the counter first or last, whichever of the two counts."""
    start = data.payload_start[data.payload_size == _RAW_WITH_COUNTER]
    if 2 * start.size <= len(data):
        raise InvalidInputError(
            "expected a configuration before data messages that are not raw counts with a counter, got none"
        )
    first, last = (_share_counting(data, start[:_ENOUGH] + at) for at in (0, _RAW_WITH_COUNTER - 2))
    layout = DataLayout(OutputMode.MT9) if first >= last else DataLayout(OutputMode.RAW)
    return _Slice(layout, layout.size)


def _share_counting(frames: Frames, at: IntArray) -> float:
    """How often a 16-bit number, found at `at`, rises by one from each message to the next."""
    steps = np.diff(256 * frames.data[at].astype(np.int64) + frames.data[at + 1])
    return float(np.mean(steps % (1 << 16) == 1)) if steps.size else 0.0


def _in_units(values: Values, calibration: RawCalibration | None, parts: Parts) -> Parts:
    if calibration is None:
        raise InvalidInputError("expected a calibration block before raw counts, got none")
    names = ("raw_accelerometer", "raw_gyroscope", "raw_magnetometer")
    acceleration, rate, field = calibration.to_units(np.stack([values[name] for name in names], axis=1))
    return replace(
        parts.noting(NOT_COMPENSATED),
        accelerometer_m_s2=acceleration,
        gyroscope_rad_s=rate,
        magnetometer_au=field,
    )


def _as_sent(values: Values, parts: Parts, layout: DataLayout, hints: Hints) -> Parts:
    acceleration = values.get("accelerometer_m_s2")
    orientations, notes = _orientations(values, acceleration, hints.world or layout.frame)
    return replace(
        parts.noting(*notes),
        accelerometer_m_s2=acceleration,
        gyroscope_rad_s=values.get("gyroscope_rad_s"),
        magnetometer_au=values.get("magnetometer_au"),
        orientations=orientations,
    )


def _orientations(
    values: Values, acceleration: FloatArray | None, world: str
) -> tuple[Orientations | None, tuple[str, ...]]:
    if "quaternion_wxyz" in values:
        return from_quaternions(values["quaternion_wxyz"], world), ()
    if "euler_deg" in values:
        return from_angles(values["euler_deg"], world), ()
    if "matrix" not in values:
        return None, ()
    matrices, turned = rows_or_columns(values["matrix"].reshape(-1, 3, 3), acceleration)
    return from_matrices(matrices, world), ((TRANSPOSED,) if turned else ())


def _rate_hz(configuration: Configuration | None, calibration: RawCalibration | None) -> float | None:
    rates = [source.rate_hz for source in (configuration, calibration) if source is not None]
    return next((rate for rate in rates if rate > 0.0), None)
