"""Samples from the sensor's data messages: legacy MTData by its configuration, MTData2 by its own items."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from speckle3d.core.arrays import BoolArray, ByteArray, IntArray
from speckle3d.core.errors import InvalidInputError, naming
from xsens.logs.assembly import Claim, Hints, Parts, assemble_log, quaternions_of, rotation_vectors
from xsens.logs.clocks import COUNTS, TICK_S, TICKS, Stamps, unwrap
from xsens.logs.faults import stuck_axes
from xsens.logs.samples import VECTORS, ImuLog
from xsens.messages.contents import (
    BLOCK_SIZE,
    COMPENSATION_NOTE,
    DATA,
    Configuration,
    DataLayout,
    MessageId,
    OutputMode,
    RawCalibration,
    Values,
    as_floats,
    read_items,
    utc_time_s,
)
from xsens.messages.framing import Frames, Message, find_frames


def parse_stream(data: bytes | ByteArray, hints: Hints | None = None, source: str = "stream") -> ImuLog:
    """Read the samples in a run of bytes from the sensor.

    The bytes may start in the middle of a message and have losses; the notes tell what was skipped.

    Parameters
    ----------
    data : bytes or ndarray of uint8
    hints : Hints, optional
    source : str
        Name of the bytes in errors.

    Returns
    -------
    ImuLog

    Raises
    ------
    InvalidInputError
        If they hold no data message, or lack what is needed to understand one.
    """
    with naming(source):
        frames, notes = find_frames(data), list[str]()
        data_mask = np.isin(frames.mid, DATA)
        if not data_mask.any():
            content = f"{len(frames)} others in {frames.data.size} bytes"
            raise InvalidInputError(
                f"expected messages with data, got {content if frames.data.any() else 'nothing but zeros'}"
            )
        kinds = frames.mid.astype(np.uint16) * 256 + frames.bid
        indices = np.flatnonzero(data_mask & (kinds == np.bincount(kinds[data_mask]).argmax()))
        if runs := frames.gaps():
            size = sum(length for _, length in runs)
            places = f"{len(runs)} places, first at byte {runs[0][0]}"
            notes.append(f"{size} bytes in {places}, belong to no message")
        if left_out := data_mask.sum() - indices.size:
            notes.append(f"{left_out} data messages of another kind or unit were left out")
        read = legacy_samples if frames.mid[indices[0]] == MessageId.MT_DATA else mtdata2_samples
        parts = read(frames, indices)
        parts = replace(parts, notes=(*notes, *parts.notes))
        del data, frames, indices  # as large as the samples
        return assemble_log(parts, hints or Hints(), source)


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
    computer_s = np.full(indices.size, np.nan)
    for i in np.flatnonzero(frames.mid == MessageId.UTC_TIME).tolist():
        place = np.searchsorted(indices, i)
        computer_s[place : place + 1] = utc_time_s(frames.message(i))
    notations = [quaternions_of(values[name]) for name in _NOTATIONS if name in values]
    increments = {VECTORS[0]: values["delta_v_m_s"]} if "delta_v_m_s" in values else {}
    if "delta_q_wxyz" in values:
        increments[VECTORS[1]] = rotation_vectors(values["delta_q_wxyz"])
    return Parts(
        Stamps(counter, time_s, computer_s=computer_s, **stamps),
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
    size = layout.dtype.itemsize
    fits = frames.payload_size[indices] == size
    if not fits.any() or (configuration is None and 2 * fits.sum() <= fits.size):
        raise InvalidInputError(
            f"expected data messages of {size} bytes, as configured before them or else as an MT9-B's raw "
            f"counts, got {fits.sum()} of {fits.size}"
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
    period_s = 1.0 / rates[0] if rates else np.nan
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
