"""Samples from the sensor's data messages: legacy MTData by its configuration, MTData2 by its own items."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from speckle3d.core.arrays import BoolArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import COUNTS, TICK_S, TICKS, Stamps, unwrap
from xsens.logs.faults import stuck_axes
from xsens.logs.parts import Parts
from xsens.logs.samples import VECTORS
from xsens.logs.worlds import Claim, quaternions_of, rotation_vectors
from xsens.messages.control import (
    BLOCK_SIZE,
    COMPENSATION_NOTE,
    Configuration,
    MessageId,
    RawCalibration,
    utc_time_s,
)
from xsens.messages.framing import Frames, Message
from xsens.messages.mtdata import DataLayout, OutputMode, Values, as_floats, read_items

_STARTS = (MessageId.WAKE_UP, MessageId.GO_TO_MEASUREMENT_ACK, MessageId.UTC_TIME)
"""Messages after which the sensor's counter may have begun anew."""


_NOTATIONS = ("quaternion_wxyz", "matrix", "euler_deg")


def _parts(
    frames: Frames, indices: IntArray, values: Values, claim: Claim, notes: list[str], **stamps: Any
) -> Parts:
    """Samples of the messages at `indices` by the values that they hold, and what else their stamps are."""
    counter, ticks = (
        unwrap(values[name][:, 0].astype(np.int64), span) if name in values else None
        for name, span in (("counter", COUNTS), ("ticks", TICKS))
    )
    time_s = None if ticks is None else ticks * TICK_S
    starts, computer_s = np.zeros(indices.size, dtype=bool), np.full(indices.size, np.nan)
    for i in np.flatnonzero(np.isin(frames.mid, _STARTS)).tolist():
        after = slice(place := int(np.searchsorted(indices, i)), place + 1)
        starts[after] = True
        if frames.mid[i] == MessageId.UTC_TIME:
            computer_s[after] = utc_time_s(frames.message(i))
    notations = [quaternions_of(values[name]) for name in _NOTATIONS if name in values]
    increments = {VECTORS[0]: values["delta_v_m_s"]} if "delta_v_m_s" in values else {}
    if "delta_q_wxyz" in values:
        increments[VECTORS[1]] = rotation_vectors(values["delta_q_wxyz"])
    return Parts(
        Stamps(counter, time_s, starts=starts, computer_s=computer_s, **stamps),
        {name: values[name] for name in VECTORS if name in values},
        {"": notations[0]} if notations else {},
        claim,
        tuple(notes),
        increments,
    )


# -- legacy MTData

_RAW_VECTORS = ("raw_accelerometer", "raw_gyroscope", "raw_magnetometer")
_READ_FIELDS = ("counter", *VECTORS, *_NOTATIONS)


def legacy_samples(frames: Frames, indices: IntArray) -> Parts:
    """Read the samples of the MTData messages at `indices`.

    Raises
    ------
    InvalidInputError
        If the layout, or the calibration of raw counts, is not in the log.
    """
    configuration = _last(frames, frames.mid == MessageId.CONFIGURATION, Configuration.from_message)
    blocks = (frames.mid == MessageId.EMTS) & (frames.payload_size == BLOCK_SIZE)
    calibration = _last(frames, blocks, RawCalibration.from_message)
    units = (configuration and configuration.units) or [(OutputMode.MT9, 0)]
    if len(units) > 1:
        raise InvalidInputError(f"expected the log of one unit, got that of a master of {len(units)}")
    layout, notes = DataLayout(*units[0]), list[str]()
    fits = frames.payload_size[indices] == layout.size
    if not fits.any() or (configuration is None and 2 * fits.sum() <= fits.size):
        whose = (
            "as configured" if configuration else "as an MT9-B's raw counts, or a configuration before them"
        )
        raise InvalidInputError(
            f"expected data messages of {layout.size} bytes, {whose}, got {fits.sum()} of {fits.size}"
        )
    if not fits.all():
        notes.append(f"{(~fits).sum()} data messages were not as long as configured: left out")
        indices = indices[fits]
    rates = [source.rate_hz for source in (configuration, calibration) if source and source.rate_hz > 0.0]
    data = frames[indices]
    values = {f.name: as_floats(layout.decode(data, f.name)) for f in layout.fields if f.name in _READ_FIELDS}
    if layout.mode & (OutputMode.RAW | OutputMode.MT9):
        if calibration is None:
            raise InvalidInputError("expected a calibration block before raw counts, got none")
        notes.append(COMPENSATION_NOTE)
        for sensor, name in enumerate(VECTORS):
            counts = layout.decode(data, _RAW_VECTORS[sensor])
            ends = stuck_axes(counts)  # which the units' mixture of axes would hide
            values[name] = calibration.to_units(sensor, as_floats(counts))
            if ends.any():
                values[name][ends] = np.nan
                notes.append(
                    f"{name.split('_')[0]}: {ends.sum()} with an axis that stands still: taken as missing"
                )
    period_s = 1.0 / rates[0] if rates else float("nan")
    return _parts(frames, indices, values, Claim(layout.frame, "as configured"), notes, period_s=period_s)


def _last(frames: Frames, indices: BoolArray, read: Callable[[Message], Any]) -> Any:
    """The last of some messages that can be read."""
    for i in np.flatnonzero(indices)[::-1].tolist():
        with suppress(InvalidInputError):
            return read(frames.message(i))
    return None


# -- MTData2


def mtdata2_samples(frames: Frames, indices: IntArray) -> Parts:
    """Read the samples of the MTData2 messages at `indices`.

    Messages without a measurement, as those of a satellite receiver, are no samples, but raise the counter.

    Raises
    ------
    InvalidInputError
        If none holds a measurement, or none a time.
    """
    values, world, rows, damage = read_items(frames[indices])
    notes = []
    if damage.any():
        notes.append(f"{damage.sum()} messages could not be taken apart and were left out")
    for name in ("counter", "ticks"):
        if name in values:
            rows &= np.isfinite(values[name][:, 0])
    if not rows.any():
        raise InvalidInputError(
            f"expected measurements with a time in {indices.size} MTData2 messages, got none"
        )
    extras = None
    if not rows.all():
        notes.append(f"{(~rows).sum()} messages without a measurement or its time are no samples")
        values = {name: column[rows] for name, column in values.items()}
        extras, indices = np.cumsum(~rows, dtype=np.int64)[rows], indices[rows]
    return _parts(frames, indices, values, Claim(world or "NWU", "as its messages say"), notes, extras=extras)
