"""Decode the self-describing data message MTData2: items of identifier, size and data.

The last four bits of an identifier give the format of its real numbers and their world: ENU, NED or NWU.
Items without a measurement or a time stamp, or of another length than they should have, are passed over.

A sensor repeats few arrangements of items: each is taken apart once, and `columns` reads its numbers from all
messages that share it. Only damage makes many arrangements; those are taken apart one by one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from speckle3d.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from xsens.messages.framing import Frames
from xsens.messages.mtdata import NumberFormat, numbers_from_bytes


class Kind(NamedTuple):
    """Meaning of an identifier: `numbers` real numbers, or a whole number of the NumPy type `whole`."""

    name: str
    numbers: int
    whole: str = ""


KINDS = {
    0x1020: Kind("packet_counter", 1, ">u2"),
    0x1060: Kind("sample_time_fine", 1, ">u4"),
    0x2010: Kind("quaternion_wxyz", 4),
    0x2020: Kind("rotation_matrix_by_column", 9),
    0x2030: Kind("euler_deg", 3),
    0x4010: Kind("delta_v_m_s", 3),
    0x4020: Kind("acceleration_m_s2", 3),
    0x8020: Kind("rate_of_turn_rad_s", 3),
    0x8030: Kind("delta_q_wxyz", 4),
    0xC020: Kind("magnetic_field_au", 3),
}
"""Identifiers of the vendor's list that are read, their last four bits zero for real numbers."""

_WORLDS = ("ENU", "NED", "NWU")


def kind_of(identifier: int) -> Kind | None:
    """Meaning of `identifier` in any format and world; None if it is not read."""
    general = KINDS.get(identifier & 0xFFF0)
    return general if general and not general.whole and identifier & 0xC != 0xC else KINDS.get(identifier)


def name_of(identifier: int) -> str:
    """Name of an item; empty if it is not read."""
    kind = kind_of(identifier)
    return kind.name if kind else ""


def world_of(identifier: int) -> str:
    """World of an orientation: ENU, NED or NWU."""
    return _WORLDS[(identifier >> 2) & 3]


Arrangement = tuple[tuple[int, int, int], ...]
"""Identifier, and first byte and size of the data, of each item of a payload."""

_SOME = 1 << 15
"""Messages taken apart at a time, so that their bytes are not held in memory twice."""

_MOST_ARRANGEMENTS = 32
"""Arrangements that messages of one length may have before they are taken apart one by one."""


@dataclass(frozen=True)
class Column:
    """Numbers of one item from all messages that hold it.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Indices of the messages, rising.
    values : ndarray, shape (n, count)
    """

    rows: IntArray
    values: FloatArray


def columns(frames: Frames) -> tuple[dict[int, Column], int]:
    """Numbers of the items of MTData2 messages by identifier, and how many messages are damaged."""
    found: dict[int, list[Column]] = defaultdict(list)
    damaged = 0
    for first in range(0, len(frames), _SOME):
        some = frames[first : first + _SOME]
        sizes = some.payload_size
        for size in np.unique(sizes):
            rows = np.flatnonzero(sizes == size)
            payloads = some[rows].payloads()
            for items, same in _by_arrangement(payloads):
                damaged += same.size if items is None else 0
                alike = payloads if same.size == len(payloads) else payloads[same]
                for identifier, at, length in items or ():
                    values = _numbers(identifier, alike[:, at : at + length])
                    if values is not None:
                        found[identifier].append(Column((first + rows[same]).astype(np.int32), values))
    return {identifier: _joined(found.pop(identifier)) for identifier in list(found)}, damaged


def _by_arrangement(payloads: ByteArray) -> Iterator[tuple[Arrangement | None, IntArray]]:
    """Arrangements (None if damaged) and the indices of the payloads, all of one length, that have them."""
    left = np.arange(len(payloads))
    for _ in range(_MOST_ARRANGEMENTS):
        if not left.size:
            return
        items = _items(payloads[left[0]].tobytes())
        same = _like_the_first(payloads[left], items or ())
        yield items, left[same]
        left = left[~same]
    others: dict[Arrangement | None, list[int]] = defaultdict(list)
    for row in left.tolist():
        others[_items(payloads[row].tobytes())].append(row)
    yield from ((items, np.array(rows)) for items, rows in others.items())


def _items(payload: bytes) -> Arrangement | None:
    """Items of a payload; None if one claims more bytes than are left."""
    items, at = [], 0
    while at < len(payload):
        size = payload[at + 2] if at + 2 < len(payload) else 0
        if at + 3 + size > len(payload):
            return None
        items.append((payload[at] << 8 | payload[at + 1], at + 3, size))
        at += 3 + size
    return tuple(items)


def _like_the_first(payloads: ByteArray, items: Arrangement) -> BoolArray:
    """Mark payloads with the first one's identifiers and sizes; without items, the first alone."""
    heads = [at + k for _, at, _ in items for k in (-3, -2, -1)]
    if not heads:
        return np.asarray(np.arange(len(payloads)) == 0)
    return np.asarray((payloads[:, heads] == payloads[0, heads]).all(axis=1))


def _numbers(identifier: int, data: ByteArray) -> FloatArray | None:
    """Numbers of an item from rows of its bytes; None if it is not read, or of another size."""
    kind, form = kind_of(identifier), NumberFormat(identifier & 3)
    if kind is None:
        return None
    one = np.dtype(kind.whole).itemsize if kind.whole else form.size
    if data.shape[1] != kind.numbers * one:
        return None
    if kind.whole:
        return np.ascontiguousarray(data).view(kind.whole).astype(np.float64)
    return numbers_from_bytes(data, form)


def _joined(pieces: list[Column]) -> Column:
    rows = np.concatenate([piece.rows for piece in pieces])
    values = np.concatenate([piece.values for piece in pieces])
    if (np.diff(rows) >= 0).all():
        return Column(rows, values)
    order = np.argsort(rows, kind="stable")
    return Column(rows[order], values[order])
