"""Samples from the sensor's data messages: legacy MTData by its configuration, MTData2 by its own items."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import Stamps
from xsens.logs.parts import Parts, of_unit_length, only
from xsens.logs.samples import VECTORS
from xsens.logs.worlds import Claim
from xsens.messages.control import Configuration, MessageId, utc_time_s
from xsens.messages.framing import Frames, Message
from xsens.messages.mtdata import DataLayout, OutputMode, Values
from xsens.messages.mtdata2 import columns, name_of, world_of
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


Found = tuple[Stamps, Parts, Claim, tuple[FloatArray | None, ...]]
"""Samples, and their orientation as quaternions, matrices or angles: all that the bytes are needed for."""


def legacy_samples(frames: Frames, which: IntArray, parts: Parts) -> Found:
    """Read the samples of the MTData messages at indices `which`.

    Raises
    ------
    InvalidInputError
        If the layout, or the calibration of raw counts, is not in the log.
    """
    configuration = _last(
        frames, np.flatnonzero(frames.mid == MessageId.CONFIGURATION), Configuration.from_message
    )
    blocks = np.flatnonzero(frames.mid == MessageId.EMTS)
    blocks = blocks[frames[blocks].payload_size == BLOCK_SIZE]
    calibration = _last(frames, blocks, RawCalibration.from_message)
    layout = _layout(frames[which], configuration)
    fits = frames[which].payload_size == layout.size
    if not fits.any():
        raise InvalidInputError(f"expected data messages of {layout.size} bytes, as configured, got none")
    if not fits.all():
        parts = parts.noting(f"{(~fits).sum()} data messages were not as long as configured: left out")
    which = only(which, fits)
    data = frames[which]
    raw = layout.mode & _RAW
    if raw and calibration is None:
        raise InvalidInputError("expected a calibration block before raw counts, got none")
    rates = [source.rate_hz for source in (configuration, calibration) if source is not None]
    rate_hz = next((rate for rate in rates if rate > 0.0), float("nan"))
    stamps = replace(_stretches(frames, which), period_s=1.0 / rate_hz)
    notations = ("quaternion_wxyz", "matrix", "euler_deg")
    counter = _all_of(layout, data, ("counter",)).get("counter")
    if counter is not None:
        stamps, counter = replace(stamps, counter=counter[:, 0].astype(np.int64)), None
    values = _all_of(layout, data, (*notations, *VECTORS))
    if raw and calibration is not None:
        values |= zip(VECTORS, _in_units(layout, data, calibration), strict=True)
        parts = parts.noting(NOT_COMPENSATED)
    parts = replace(parts, vectors=tuple(map(values.get, VECTORS)))
    return stamps, parts, Claim(layout.frame, "as configured"), tuple(map(values.get, notations))


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


def _in_units(layout: DataLayout, data: Frames, calibration: RawCalibration) -> FloatArray:
    names = ("raw_accelerometer", "raw_gyroscope", "raw_magnetometer")
    vectors = np.empty((3, len(data), 3))
    for some, values in _decoded(layout, data):
        vectors[:, some] = calibration.to_units(np.stack([values[name] for name in names], axis=1))
    return vectors


# -- MTData2

_NOTATIONS = ("quaternion_wxyz", "rotation_matrix_by_column", "euler_deg")
_STAMPS = ("packet_counter", "sample_time_fine")


def mtdata2_samples(frames: Frames, which: IntArray, parts: Parts) -> Found:
    """Read the samples of the MTData2 messages at indices `which`.

    Messages without a measurement, as those of a satellite receiver, are no samples, but raise the counter.

    Raises
    ------
    InvalidInputError
        If none holds a measurement, or none a time.
    """
    items, world, rows, damaged = _items(frames[which])
    if damaged:
        parts = parts.noting(f"{damaged} messages could not be taken apart and were left out")
    told = [items.pop(name, None) for name in _STAMPS]
    for stamp in told:
        rows &= True if stamp is None else np.isfinite(stamp[:, 0])
    if not rows.any():
        raise InvalidInputError(
            f"expected measurements with a time in {which.size} MTData2 messages, got none"
        )
    if not rows.all():
        parts = parts.noting(f"{(~rows).sum()} messages without a measurement or its time are no samples")
        items = {name: values[rows] for name, values in items.items()}
    stamps = _stretches(frames, only(which, rows))
    counter, ticks = (None if stamp is None else stamp[rows, 0].astype(np.int64) for stamp in told)
    others = None if rows.all() else np.cumsum(~rows, dtype=np.int64)[rows]
    stamps = replace(stamps, counter=counter, ticks=ticks, others=others)
    claim = Claim(world, "as its messages say")
    return stamps, _measured(items, parts), claim, tuple(map(items.get, _NOTATIONS))


def _items(frames: Frames) -> tuple[Values, str, BoolArray, int]:
    """Items of messages by name, NaN where missing; their world; which measure; how many are damaged.

    Orientations in another world than the first are left out.
    """
    items: Values = {}
    world, damaged = "", 0
    measured = np.zeros(len(frames), dtype=bool)
    for first in range(0, len(frames), _SOME):
        found, bad = columns(frames[first : first + _SOME])
        damaged += bad
        for identifier, column in found.items():
            name, values, rows = name_of(identifier), column.values, first + column.rows
            measured[rows] |= name not in _STAMPS
            if name in _NOTATIONS:
                world = world or world_of(identifier)
                if world != world_of(identifier):
                    continue
            if name == _NOTATIONS[1]:
                values = values.reshape(-1, 3, 3).swapaxes(1, 2).reshape(-1, 9)
            if name not in items:
                items[name] = np.full((len(frames), values.shape[1]), np.nan)
            items[name][rows] = values
    return items, world or "NWU", measured, damaged


def _measured(items: Values, parts: Parts) -> Parts:
    """Add readings, or increments in their place."""
    acceleration, rate = items.get("acceleration_m_s2"), items.get("rate_of_turn_rad_s")
    increments = []
    if acceleration is None and (acceleration := items.get("delta_v_m_s")) is not None:
        parts = parts.noting("acceleration is the sensor's velocity increments over its sampling period")
        increments.append(VECTORS[0])
    if rate is None and (turns := items.get("delta_q_wxyz")) is not None:
        unit = of_unit_length(turns)[:, None]
        turned = Rotation.from_quat(np.where(unit, turns, 1.0), scalar_first=True)
        rate = np.where(unit, turned.as_rotvec(), np.nan)
        parts = parts.noting("rate of turn is the sensor's orientation increments over its sampling period")
        increments.append(VECTORS[1])
    vectors = (acceleration, rate, items.get("magnetic_field_au"))
    return replace(parts, vectors=vectors, increments=tuple(increments))
