"""Columns of numbers from many MTData2 messages at once.

A sensor sends few different arrangements of items, over and over: each is taken apart once, and its numbers
are read from all messages that share it. Only damage makes many; they are taken apart one by one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.messages.framing import Frames
from xsens.messages.mtdata2 import Kind, kind_of, number_format, parts, size_of
from xsens.messages.numberformats import numbers_from_bytes

Arrangement = tuple[tuple[int, int], ...]
"""Identifier and first byte of the items that are wanted."""

_MOST_ARRANGEMENTS = 32
"""Looked for among messages of one length before they are taken apart one by one."""


@dataclass(frozen=True)
class Column:
    """One item's numbers from the messages that hold it.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Which messages, in order.
    values : ndarray, shape (n, count)
    """

    rows: IntArray
    values: FloatArray


def columns(frames: Frames, wanted: frozenset[str]) -> tuple[dict[int, Column], int]:
    """Numbers of the `wanted` items by identifier, and how many messages could not be taken apart.

    Parameters
    ----------
    frames : Frames
        MTData2 messages.
    wanted : frozenset of str
        Names of items of numbers that are all of one type.
    """
    found: dict[int, list[Column]] = defaultdict(list)
    damaged = 0
    for rows, payloads in _by_length(frames):
        for arrangement, same in _by_arrangement(payloads, wanted):
            if arrangement is None:
                damaged += same.size
                continue
            some = payloads if same.size == len(payloads) else payloads[same]
            for identifier, at in arrangement:
                found[identifier].append(Column(rows[same], _numbers(identifier, some, at)))
    return {identifier: _joined(pieces) for identifier, pieces in found.items()}, damaged


def _by_length(frames: Frames) -> Iterator[tuple[IntArray, ByteArray]]:
    sizes = frames.payload_size
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        yield rows, frames[rows].payloads()


def _by_arrangement(
    payloads: ByteArray, wanted: frozenset[str]
) -> Iterator[tuple[Arrangement | None, IntArray]]:
    """Arrangements (None where damaged) and which of the payloads, all of one length, have them."""
    left = np.arange(len(payloads))
    for _ in range(_MOST_ARRANGEMENTS):
        if not left.size:
            return
        items = _items(payloads[left[0]].tobytes())
        same = _like_the_first(payloads[left], items or [])
        yield _wanted(items, wanted), left[same]
        left = left[~same]
    others: dict[Arrangement | None, list[int]] = defaultdict(list)
    for row in left.tolist():
        others[_wanted(_items(payloads[row].tobytes()), wanted)].append(row)
    yield from ((arrangement, np.array(rows)) for arrangement, rows in others.items())


def _like_the_first(payloads: ByteArray, items: list[tuple[int, int, int]]) -> BoolArray:
    """Which payloads have the first one's identifiers and sizes; without items, the first alone."""
    heads = [at + k for _, at, _ in items for k in (-3, -2, -1)]
    if not heads:
        return np.asarray(np.arange(len(payloads)) == 0)
    return np.asarray((payloads[:, heads] == payloads[0, heads]).all(axis=1))


def _items(payload: bytes) -> list[tuple[int, int, int]] | None:
    try:
        return list(parts(payload))
    except InvalidInputError:
        return None


def _wanted(items: list[tuple[int, int, int]] | None, wanted: frozenset[str]) -> Arrangement | None:
    if items is None:
        return None
    return tuple((i, at) for i, at, size in items if _name(i) in wanted and size == size_of(i))


def _name(identifier: int) -> str:
    kind = kind_of(identifier)
    return kind.name if kind else ""


def _numbers(identifier: int, payloads: ByteArray, at: int) -> FloatArray:
    size = size_of(identifier)
    kind = kind_of(identifier)
    assert size is not None  # only wanted ones come here
    assert kind is not None
    data = payloads[:, at : at + size]
    if kind.reals:
        return numbers_from_bytes(data, number_format(identifier))
    return np.ascontiguousarray(data).view(_whole_type(kind)).astype(np.float64)


def _whole_type(kind: Kind) -> np.dtype[np.void]:
    code = {"B": "u1", "H": "u2", "I": "u4"}[kind.whole[-1]]
    return np.dtype(f">{code}")


def _joined(pieces: list[Column]) -> Column:
    if len(pieces) == 1:
        return pieces[0]
    rows = np.concatenate([piece.rows for piece in pieces])
    order = np.argsort(rows, kind="stable")
    return Column(rows[order], np.concatenate([piece.values for piece in pieces])[order])
