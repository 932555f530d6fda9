"""Logs that are the sensor's own bytes: the MT9 software's ``.bin``, ``.mtb``, and whatever a port sent.

A stream may start in the middle of a message and lose bytes; what belongs to no message is skipped and told.
"""

from __future__ import annotations

import struct
from datetime import UTC, datetime

import numpy as np

from speckle3d.core.arrays import ByteArray, IntArray
from speckle3d.core.errors import InvalidInputError, naming
from xsens.logs.clocks import Stamps
from xsens.logs.legacylogs import legacy_log
from xsens.logs.logparts import Hints, Parts
from xsens.logs.mtdata2logs import mtdata2_log
from xsens.logs.samples import ImuLog
from xsens.messages.catalogue import MessageId
from xsens.messages.framing import Frames, find_frames

UTC_TIME = 0x61
"""Message with the computer's clock, that a recording has before each stretch of data."""

_UTC = struct.Struct(">IH6B")
_DATA = (MessageId.MT_DATA, MessageId.MT_DATA2)
_STARTS = (MessageId.WAKE_UP, MessageId.GO_TO_MEASUREMENT_ACK, UTC_TIME)
"""Messages after which the sensor's counter may have begun anew."""


def parse_stream(data: bytes | ByteArray, hints: Hints | None = None, source: str = "stream") -> ImuLog:
    """Samples in a run of bytes from the sensor.

    Parameters
    ----------
    data : bytes or ndarray of uint8
    hints : Hints, optional
    source : str
        What to call it in errors.

    Raises
    ------
    InvalidInputError
        If no data message is in it, or what is needed to understand them is not.
    """
    frames = find_frames(data)
    with naming(source):
        which = _of_one_kind(frames)
        parts = Parts(source, (*_skipped(frames), *_left_out(frames, which)))
        read = legacy_log if frames.mid[which[0]] == MessageId.MT_DATA else mtdata2_log
        return read(frames, which, _stretches(frames, which), parts, hints or Hints())


def _of_one_kind(frames: Frames) -> IntArray:
    """Which messages are data, of the kind and from the bus id that most are."""
    data = np.flatnonzero(np.isin(frames.mid, _DATA))
    if not data.size:
        raise InvalidInputError(
            f"expected messages with data, got {len(frames)} others in {frames.data.size} bytes"
        )
    kinds = frames.mid[data].astype(np.int64) * 256 + frames.bid[data]
    names, counts = np.unique(kinds, return_counts=True)
    return np.asarray(data[kinds == names[counts.argmax()]])


def _skipped(frames: Frames) -> tuple[str, ...]:
    runs = frames.skipped()
    if not runs:
        return ()
    size = sum(length for _, length in runs)
    return (f"{size} bytes in {len(runs)} places, first at byte {runs[0][0]}, belong to no message",)


def _left_out(frames: Frames, which: IntArray) -> tuple[str, ...]:
    others = int(np.isin(frames.mid, _DATA).sum()) - which.size
    return (f"{others} data messages of another kind or unit were left out",) if others else ()


def _stretches(frames: Frames, which: IntArray) -> Stamps:
    """Before which data messages the sensor was started anew, and the computer's clock then."""
    starts = np.zeros(which.size, dtype=bool)
    computer_s = np.full(which.size, np.nan)
    starts[_next_data(np.flatnonzero(np.isin(frames.mid, _STARTS)), which)[0]] = True
    for after, i in zip(*_next_data(np.flatnonzero(frames.mid == UTC_TIME), which), strict=True):
        computer_s[after] = _computer_time(frames, int(i))
    return Stamps(starts=starts, computer_s=computer_s)


def _next_data(messages: IntArray, which: IntArray) -> tuple[IntArray, IntArray]:
    """Positions in `which` of the data that follow some messages, and the last message before each."""
    after = np.searchsorted(which, messages)
    after, messages = after[after < which.size], messages[after < which.size]
    last = np.append(after[1:] != after[:-1], True)[: after.size]
    return after[last], messages[last]


def _computer_time(frames: Frames, index: int) -> float:
    """Seconds since 1970 of a message that tells the time; NaN if it does not."""
    message = frames.message(index)
    if message.mid != UTC_TIME or len(message.payload) != _UTC.size:
        return float("nan")
    nanosecond, year, month, day, hour, minute, second, _ = _UTC.unpack(message.payload)
    try:
        whole = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        return float(whole.timestamp() + nanosecond * 1e-9)
    except (ValueError, OverflowError):
        return float("nan")
