"""Samples from MTData2 messages, which say themselves what they hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps
from xsens.logs.logparts import TRANSPOSED, Hints, Parts, on_clock
from xsens.logs.samples import ImuLog
from xsens.logs.worlds import Orientations, from_angles, from_matrices, from_quaternions, rows_or_columns
from xsens.messages.columns import Column, columns
from xsens.messages.framing import Frames
from xsens.messages.mtdata2 import kind_of, world_of

_MEASURED = (
    "acceleration_m_s2",
    "rate_of_turn_rad_s",
    "magnetic_field_au",
    "delta_v_m_s",
    "delta_q_wxyz",
    "quaternion_wxyz",
    "euler_deg",
    "rotation_matrix_by_column",
)
_STAMPS = ("packet_counter", "sample_time_fine")
_TICK_S = 1e-4

Table = dict[int, Column]


def mtdata2_log(frames: Frames, which: IntArray, stamps: Stamps, parts: Parts, hints: Hints) -> ImuLog:
    """Samples of the MTData2 messages `which`.

    Messages that hold no measurement, as those of a satellite receiver, are no samples, but count.

    Raises
    ------
    InvalidInputError
        If none holds a measurement, or none a time.
    """
    table, damaged = columns(frames[which], frozenset((*_MEASURED, *_STAMPS)))
    if damaged:
        parts = parts.noting(f"{damaged} messages could not be taken apart and were left out")
    rows = _sample_rows(table, which.size)
    if not rows.any():
        raise InvalidInputError(
            f"expected measurements with a time in {which.size} MTData2 messages, got none"
        )
    if not rows.all():
        parts = parts.noting(f"{(~rows).sum()} messages without a measurement or its time are no samples")
    log = on_clock(
        _stamped(table, rows, stamps), int(rows.sum()), _measured(table, rows, parts, hints), hints
    )
    return _per_second(log, table)


def _sample_rows(table: Table, size: int) -> BoolArray:
    """Messages that hold a measurement, and whatever tells the time if any message does."""
    rows = np.zeros(size, dtype=bool)
    for identifier, column in table.items():
        if _name(identifier) in _MEASURED:
            rows[column.rows] = True
    for stamp in _STAMPS:
        told = _filled(table, stamp, size, 1)
        if told is not None:
            rows &= np.isfinite(told[:, 0])
    return rows


def _name(identifier: int) -> str:
    kind = kind_of(identifier)
    return kind.name if kind else ""


def _filled(table: Table, name: str, size: int, count: int) -> FloatArray | None:
    """The item called `name` for every message, shape (size, count), NaN where it is missing."""
    found = [column for identifier, column in table.items() if _name(identifier) == name]
    if not found:
        return None
    if len(found) == 1 and found[0].rows.size == size and (np.diff(found[0].rows) == 1).all():
        return found[0].values
    values = np.full((size, count), np.nan)
    for column in found:
        values[column.rows] = column.values
    return values


def _of(values: FloatArray, rows: BoolArray) -> FloatArray:
    return values if rows.all() else values[rows]


def _stamped(table: Table, rows: BoolArray, stamps: Stamps) -> Stamps:
    counter, ticks = (_whole(_filled(table, name, rows.size, 1), rows) for name in _STAMPS)
    # A new start before a message that is no sample is one before the next sample.
    at = np.flatnonzero(rows)
    starts, computer_s = np.zeros(at.size, dtype=bool), np.full(at.size, np.nan)
    if stamps.starts is not None and stamps.computer_s is not None:
        for i in np.flatnonzero(stamps.starts):
            after = int(np.searchsorted(at, i))
            if after < at.size:
                starts[after], computer_s[after] = True, stamps.computer_s[i]
    others = np.cumsum(~rows, dtype=np.int64)[rows]
    return Stamps(counter, ticks, tick_s=_TICK_S, others=others, starts=starts, computer_s=computer_s)


def _whole(values: FloatArray | None, rows: BoolArray) -> IntArray | None:
    return None if values is None else values[rows, 0].astype(np.int64)


def _measured(table: Table, rows: BoolArray, parts: Parts, hints: Hints) -> Parts:
    def vectors(name: str, count: int = 3) -> FloatArray | None:
        values = _filled(table, name, rows.size, count)
        return None if values is None else _of(values, rows)

    acceleration, rate = vectors("acceleration_m_s2"), vectors("rate_of_turn_rad_s")
    orientations, notes = _orientations(table, rows, acceleration, hints)
    if acceleration is None and (acceleration := vectors("delta_v_m_s")) is not None:
        notes = (*notes, "acceleration is the sensor's velocity increments over its sampling period")
    if rate is None and (turns := vectors("delta_q_wxyz", 4)) is not None:
        turned = from_quaternions(turns, "NWU")
        rate = np.where(turned.there[:, None], turned.world_from_sensor.as_rotvec(), np.nan)
        notes = (*notes, "rate of turn is the sensor's orientation increments over its sampling period")
    return replace(
        parts.noting(*notes),
        accelerometer_m_s2=acceleration,
        gyroscope_rad_s=rate,
        magnetometer_au=vectors("magnetic_field_au"),
        orientations=orientations,
    )


def _per_second(log: ImuLog, table: Table) -> ImuLog:
    """Increments made rates, where there are only increments; their period is the clock's."""
    names = {_name(identifier) for identifier in table}
    if log.accelerometer_m_s2 is not None and "acceleration_m_s2" not in names:
        log = replace(log, accelerometer_m_s2=log.accelerometer_m_s2 * log.rate_hz)
    if log.gyroscope_rad_s is not None and "rate_of_turn_rad_s" not in names:
        log = replace(log, gyroscope_rad_s=log.gyroscope_rad_s * log.rate_hz)
    return log


def _orientations(
    table: Table, rows: BoolArray, acceleration: FloatArray | None, hints: Hints
) -> tuple[Orientations | None, tuple[str, ...]]:
    """From quaternions, else angles, else matrices; each in the world that most messages say."""
    for name in ("quaternion_wxyz", "euler_deg", "rotation_matrix_by_column"):
        found = {i: column for i, column in table.items() if _name(i) == name}
        if found:
            most = max(found, key=lambda i: found[i].rows.size)
            world = hints.world or world_of(most)
            values = _filled({most: found[most]}, name, rows.size, found[most].values.shape[1])
            assert values is not None
            return _turned(name, _of(values, rows), world, acceleration)
    return None, ()


def _turned(
    name: str, values: FloatArray, world: str, acceleration: FloatArray | None
) -> tuple[Orientations, tuple[str, ...]]:
    if name == "quaternion_wxyz":
        return from_quaternions(values, world), ()
    if name == "euler_deg":
        return from_angles(values, world), ()
    rows_first, turned = rows_or_columns(np.swapaxes(values.reshape(-1, 3, 3), 1, 2), acceleration)
    return from_matrices(rows_first, world), ((TRANSPOSED,) if turned else ())
