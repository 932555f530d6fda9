"""Samples from the sensor's data messages: legacy MTData by its configuration, MTData2 by its own items."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps
from xsens.logs.parts import Hints, Parts, of_unit_length, on_clock, only, oriented
from xsens.logs.samples import VECTORS, ImuLog
from xsens.logs.worlds import Claim
from xsens.messages.control import Configuration, MessageId, utc_time_s
from xsens.messages.framing import Frames, Message
from xsens.messages.mtdata import DataLayout, OutputMode, Values
from xsens.messages.mtdata2 import Column, columns, name_of, world_of
from xsens.messages.rawcounts import BLOCK_SIZE, NOT_COMPENSATED, RawCalibration

_Read = TypeVar("_Read")

_STARTS = (MessageId.WAKE_UP, MessageId.GO_TO_MEASUREMENT_ACK, MessageId.UTC_TIME)
"""Messages after which the sensor's counter may have begun anew."""


def _stretches(frames: Frames, which: IntArray) -> Stamps:
    """Mark the data messages before which the sensor was started anew, with the computer's clock then."""
    at = np.flatnonzero(np.isin(frames.mid, _STARTS))
    after = np.searchsorted(which, at)
    at, after = at[after < which.size], after[after < which.size]
    starts = np.zeros(which.size, dtype=bool)
    starts[after] = True
    utc = frames.mid[at] == MessageId.UTC_TIME
    computer_s = np.full(which.size, np.nan) if utc.any() else None
    if computer_s is not None:
        for i, message in dict(zip(after[utc].tolist(), at[utc].tolist(), strict=True)).items():
            computer_s[i] = utc_time_s(frames.message(message))
    return Stamps(starts=starts, computer_s=computer_s)


# -- legacy MTData

_RAW = OutputMode.RAW | OutputMode.MT9
_RAW_WITH_COUNTER = 22
_SOME = 1 << 15
"""Messages decoded at a time: as numbers they take several times their memory."""

_ENOUGH = 10_000
"""Messages that show where the counter is."""


def legacy_log(frames: Frames, which: IntArray, parts: Parts, hints: Hints) -> ImuLog:
    """Read the samples of the MTData messages at indices `which`.

    Raises
    ------
    InvalidInputError
        If layout, rate or calibration is neither in the log nor in the hints.
    """
    configuration = _last(
        frames, np.flatnonzero(frames.mid == MessageId.CONFIGURATION), Configuration.from_message
    )
    blocks = np.flatnonzero(frames.mid == MessageId.EMTS)
    blocks = blocks[frames[blocks].payload_size == BLOCK_SIZE]
    calibration = hints.calibration or _last(frames, blocks, RawCalibration.from_message)
    layout = _layout(frames[which], configuration)
    fits = frames[which].payload_size == layout.size
    if not fits.any():
        raise InvalidInputError(f"expected data messages of {layout.size} bytes, as configured, got none")
    if not fits.all():
        parts = parts.noting(f"{(~fits).sum()} data messages were not as long as configured: left out")
    which = only(which, fits)
    data = frames[which]
    if not layout.mode & _RAW:
        read = partial(_as_sent, layout, data, parts, hints)
    elif calibration is not None:
        read = partial(_in_units, layout, data, calibration, parts)
    else:
        raise InvalidInputError("expected a calibration block before raw counts, got none")
    rates = [source.rate_hz for source in (configuration, calibration) if source is not None]
    rate_hz = hints.rate_hz or next((rate for rate in rates if rate > 0.0), None)
    counts = _all_of(layout, data, ("counter",))
    counter = counts["counter"][:, 0].astype(np.int64) if counts else None
    stamps = replace(_stretches(frames, which), counter=counter)
    return on_clock(stamps, len(data), read, replace(hints, rate_hz=rate_hz))


def _decoded(layout: DataLayout, frames: Frames) -> Iterator[tuple[slice, Values]]:
    """Values of some thousand messages at a time, with their places among all."""
    for first in range(0, len(frames), _SOME):
        some = slice(first, first + _SOME)
        yield some, layout.decode(frames[some].payloads())


def _all_of(layout: DataLayout, frames: Frames, names: tuple[str, ...]) -> Values:
    """Values of those fields that are there, of all messages."""
    counts = {field.name: field.count for field in layout.fields if field.name in names}
    values = {name: np.empty((len(frames), count)) for name, count in counts.items()}
    for some, decoded in _decoded(layout, frames) if counts else ():
        for name, column in values.items():
            column[some] = decoded[name]
    return values


def _last(frames: Frames, which: IntArray, read: Callable[[Message], _Read]) -> _Read | None:
    """The last of some messages that can be read."""
    for i in which[::-1].tolist():
        with suppress(InvalidInputError):
            return read(frames.message(i))
    return None


def _layout(data: Frames, configuration: Configuration | None) -> DataLayout:
    """Layout as configured, or of raw counts; their counter is first or last, whichever rises by one."""
    units = configuration.units if configuration is not None else ()
    if len(units) > 1:
        raise InvalidInputError(f"expected the log of one unit, got that of a master of {len(units)}")
    if units and not units[0].output_mode & _RAW:
        return DataLayout(units[0].output_mode, units[0].output_settings)
    start = data.payload_start[data.payload_size == _RAW_WITH_COUNTER]
    if 2 * start.size <= len(data):
        raise InvalidInputError(
            "expected a configuration before data messages that are not raw counts with a counter, got none"
        )
    first, last = (_share_counting(data, start[:_ENOUGH] + at) for at in (0, _RAW_WITH_COUNTER - 2))
    return DataLayout(OutputMode.MT9 if first >= last else OutputMode.RAW)


def _share_counting(frames: Frames, at: IntArray) -> float:
    """How often a 16-bit number, found at `at`, rises by one from each message to the next."""
    steps = np.diff(256 * frames.data[at].astype(np.int64) + frames.data[at + 1])
    return float(np.mean(steps % (1 << 16) == 1)) if steps.size else 0.0


def _in_units(layout: DataLayout, data: Frames, calibration: RawCalibration, parts: Parts) -> Parts:
    names = ("raw_accelerometer", "raw_gyroscope", "raw_magnetometer")
    vectors = np.empty((3, len(data), 3))
    for some, values in _decoded(layout, data):
        vectors[:, some] = calibration.to_units(np.stack([values[name] for name in names], axis=1))
    return replace(parts.noting(NOT_COMPENSATED), vectors=tuple(vectors))


def _as_sent(layout: DataLayout, data: Frames, parts: Parts, hints: Hints) -> Parts:
    notations = ("quaternion_wxyz", "matrix", "euler_deg")
    values = _all_of(layout, data, (*VECTORS, *notations))
    parts = replace(parts, vectors=tuple(map(values.get, VECTORS)))
    return oriented(parts, Claim(layout.frame, "as configured"), hints, *map(values.get, notations))


# -- MTData2

_NOTATIONS = {
    "quaternion_wxyz": "quaternions",
    "rotation_matrix_by_column": "matrices",
    "euler_deg": "angles_deg",
}
"""Parameter of `oriented` by the name of the item."""

_STAMPS = ("packet_counter", "sample_time_fine")

_Table = dict[int, Column]
"""Numbers by the identifier of the item."""


def mtdata2_log(frames: Frames, which: IntArray, parts: Parts, hints: Hints) -> ImuLog:
    """Read the samples of the MTData2 messages at indices `which`.

    Messages without a measurement, as those of a satellite receiver, are no samples, but raise the counter.

    Raises
    ------
    InvalidInputError
        If none holds a measurement, or none a time.
    """
    table, damaged = columns(frames[which])
    if damaged:
        parts = parts.noting(f"{damaged} messages could not be taken apart and were left out")
    told = [_filled(table, name, which.size) for name in _STAMPS]
    rows = np.zeros(which.size, dtype=bool)
    for identifier, column in table.items():
        rows[column.rows] |= name_of(identifier) not in _STAMPS
    for values in told:
        rows &= True if values is None else np.isfinite(values[:, 0])
    if not rows.any():
        raise InvalidInputError(
            f"expected measurements with a time in {which.size} MTData2 messages, got none"
        )
    if not rows.all():
        parts = parts.noting(f"{(~rows).sum()} messages without a measurement or its time are no samples")
    counter, ticks = (None if values is None else values[rows, 0].astype(np.int64) for values in told)
    others = None if rows.all() else np.cumsum(~rows, dtype=np.int64)[rows]
    stamps = replace(_stretches(frames, only(which, rows)), counter=counter, ticks=ticks, others=others)
    log = on_clock(stamps, int(rows.sum()), partial(_measured, table, rows, parts, hints), hints)
    if log.accelerometer_m_s2 is not None and not _named(table, "acceleration_m_s2"):
        log = replace(log, accelerometer_m_s2=log.accelerometer_m_s2 * log.rate_hz)
    if log.gyroscope_rad_s is not None and not _named(table, "rate_of_turn_rad_s"):
        log = replace(log, gyroscope_rad_s=log.gyroscope_rad_s * log.rate_hz)
    return log


def _named(table: _Table, name: str) -> _Table:
    return {identifier: column for identifier, column in table.items() if name_of(identifier) == name}


def _filled(table: _Table, name: str, size: int) -> FloatArray | None:
    """The item called `name` for every message, shape (size, count), NaN where it is missing."""
    found = list(_named(table, name).values())
    if not found:
        return None
    if len(found) == 1 and found[0].rows.size == size and (np.diff(found[0].rows) == 1).all():
        return found[0].values
    values = np.full((size, found[0].values.shape[1]), np.nan)
    for column in found:
        values[column.rows] = column.values
    return values


def _measured(table: _Table, rows: BoolArray, parts: Parts, hints: Hints) -> Parts:
    """Readings, or increments in their place, and the orientation whose identifier most messages have."""

    def item(name: str) -> Any:
        return only(_filled(table, name, rows.size), rows)

    acceleration, rate = item("acceleration_m_s2"), item("rate_of_turn_rad_s")
    if acceleration is None and (acceleration := item("delta_v_m_s")) is not None:
        parts = parts.noting("acceleration is the sensor's velocity increments over its sampling period")
    if rate is None and (turns := item("delta_q_wxyz")) is not None:
        unit = of_unit_length(turns)[:, None]
        turned = Rotation.from_quat(np.where(unit, turns, 1.0), scalar_first=True)
        rate = np.where(unit, turned.as_rotvec(), np.nan)
        parts = parts.noting("rate of turn is the sensor's orientation increments over its sampling period")
    parts = replace(parts, vectors=(acceleration, rate, item("magnetic_field_au")))
    for name, notation in _NOTATIONS.items():
        if found := _named(table, name):
            most = max(found, key=lambda i: found[i].rows.size)
            values = only(_filled({most: found[most]}, name, rows.size), rows)
            if notation == "matrices":
                values = np.swapaxes(values.reshape(-1, 3, 3), 1, 2).reshape(-1, 9)
            return oriented(parts, Claim(world_of(most), "as its messages say"), hints, **{notation: values})
    return parts
