"""Decode the self-describing data message MTData2: items of identifier, size and data.

The last four bits of an identifier give the format of its real numbers and their world: ENU, NED or NWU.
Items without a measurement or a time stamp, or of another length than they should have, are passed over.
"""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from xsens.messages.framing import Frames, rows_at
from xsens.messages.mtdata import REAL, Field, as_floats

KINDS = {
    0x1020: Field("packet_counter", 1, ">u2"),
    0x1060: Field("sample_time_fine", 1, ">u4"),
    0x2010: Field("quaternion_wxyz", 4),
    0x2020: Field("rotation_matrix_by_column", 9),
    0x2030: Field("euler_deg", 3),
    0x4010: Field("delta_v_m_s", 3),
    0x4020: Field("acceleration_m_s2", 3),
    0x8020: Field("rate_of_turn_rad_s", 3),
    0x8030: Field("delta_q_wxyz", 4),
    0xC020: Field("magnetic_field_au", 3),
}
"""Identifiers of the vendor's list that are read, their last four bits zero for real numbers."""

_WORLDS = ("ENU", "NED", "NWU")


def kind_of(identifier: int) -> Field | None:
    """Meaning of `identifier` in any format and world; None if it is not read."""
    general = KINDS.get(identifier & 0xFFF0)
    return general if general and not general.whole and identifier & 0xC != 0xC else KINDS.get(identifier)


def name_of(identifier: int) -> str:
    """Name of an item; empty if it is not read."""
    return kind.name if (kind := kind_of(identifier)) else ""


def world_of(identifier: int) -> str:
    """World of an orientation: ENU, NED or NWU."""
    return _WORLDS[(identifier >> 2) & 3]


class Column(NamedTuple):
    """Numbers of one item, shape (n, count), and the rising indices of the n messages that hold it."""

    rows: IntArray
    values: FloatArray


def columns(frames: Frames) -> tuple[dict[int, Column], int]:
    """Numbers of the items of MTData2 messages by identifier, and how many messages are damaged.

    All messages are taken apart side by side: their first items, their second ones, and so on. One whose
    last item claims more bytes than it has is damaged, and left out.
    """
    found: dict[int, list[Column]] = defaultdict(list)
    damaged = np.zeros(len(frames), dtype=bool)
    data, at, end = frames.data, frames.payload_start, frames.end - 1
    rows = np.arange(at.size, dtype=at.dtype)
    left = at < end
    while left.any():
        rows, at, end = (each if left.all() else each[left] for each in (rows, at, end))
        identifiers = rows_at(data, at, 2).view(">u2")[:, 0].astype(np.uint16)
        sizes = data.take(at + 2, mode="clip")  # behind a last identifier the data may end
        after = at + 3 + sizes
        damaged[rows[after > end]] = True
        for identifier in np.unique(identifiers).tolist():
            if (kind := kind_of(identifier)) is None:
                continue
            number = np.dtype(kind.whole or REAL[identifier & 3])
            size = kind.count * number.itemsize
            there = (identifiers == identifier) & (sizes == size) & (after <= end)
            if there.any():
                values = as_floats(rows_at(data, at[there] + 3, size).view(number))
                found[identifier].append(Column(rows[there], values))
        left, at = after < end, after
    table = {identifier: _joined(found.pop(identifier), damaged) for identifier in list(found)}
    return {key: column for key, column in table.items() if column.rows.size}, int(damaged.sum())


def _joined(pieces: list[Column], damaged: BoolArray) -> Column:
    """One column of the items at several places in messages, without damaged ones, rows rising."""
    rows = np.concatenate([piece.rows for piece in pieces])
    values = np.concatenate([piece.values for piece in pieces]) if pieces[1:] else pieces[0].values
    if len(pieces) == 1 and not damaged.any():
        return Column(rows, values)
    order = np.argsort(rows, kind="stable")
    order = order[~damaged[rows[order]]]
    return Column(rows[order], values[order])
