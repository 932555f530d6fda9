"""Decode the self-describing data message MTData2: items of identifier, size and data.

The last four bits of an identifier give the format of its real numbers and their world: ENU, NED or NWU.
Items that are unknown, or of another length than they should have, are kept as bytes.

A sensor repeats few arrangements of items: each is taken apart once, and `columns` reads its numbers from all
messages that share it. Only damage makes many arrangements; those are taken apart one by one.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.messages.framing import Frames
from xsens.messages.mtdata import NumberFormat, numbers_from_bytes


@dataclass(frozen=True)
class Kind:
    """Meaning of an identifier: `reals` real numbers, or whole numbers packed as `whole`, or bytes."""

    name: str
    reals: int = 0
    whole: str = ""


_UTC = ">IHBBBBBB"
_PVT = ">IHBBBBBBIiBBBBiiiiIIiiiiiIIiHHHHHHH"
_TRIGGER = ">BBIH"

KINDS: dict[int, Kind] = {
    0x0810: Kind("temperature_c", 1),
    0x1010: Kind("utc", whole=_UTC),
    0x1020: Kind("packet_counter", whole=">H"),
    0x1030: Kind("time_of_week_ms", whole=">I"),
    0x1040: Kind("gnss_age", whole=">B"),
    0x1050: Kind("pressure_age", whole=">B"),
    0x1060: Kind("sample_time_fine", whole=">I"),
    0x1070: Kind("sample_time_coarse", whole=">I"),
    0x1080: Kind("frame_range", whole=">HH"),
    0x1090: Kind("packet_counter_8", whole=">B"),
    0x10A0: Kind("sample_time_64", whole=">Q"),
    0x2010: Kind("quaternion_wxyz", 4),
    0x2020: Kind("rotation_matrix_by_column", 9),
    0x2030: Kind("euler_deg", 3),
    0x3010: Kind("pressure_pa", whole=">I"),
    0x4010: Kind("delta_v_m_s", 3),
    0x4020: Kind("acceleration_m_s2", 3),
    0x4030: Kind("free_acceleration_m_s2", 3),
    0x4040: Kind("acceleration_high_rate_m_s2", 3),
    0x4810: Kind("trigger_in_1", whole=_TRIGGER),
    0x4820: Kind("trigger_in_2", whole=_TRIGGER),
    0x5010: Kind("altitude_above_sea_m", 1),
    0x5020: Kind("altitude_above_ellipsoid_m", 1),
    0x5030: Kind("position_ecef_m", 3),
    0x5040: Kind("latitude_longitude_deg", 2),
    0x7010: Kind("gnss_position_velocity_time", whole=_PVT),
    0x7020: Kind("gnss_satellites"),
    0x8020: Kind("rate_of_turn_rad_s", 3),
    0x8030: Kind("delta_q_wxyz", 4),
    0x8040: Kind("rate_of_turn_high_rate_rad_s", 3),
    0x8830: Kind("gps_dilution_of_precision"),
    0x8840: Kind("gps_solution"),
    0x8880: Kind("gps_time_utc"),
    0x88A0: Kind("gps_satellites"),
    0xA010: Kind("raw_acc_gyr_mag_temperature", whole=">10H"),
    0xA011: Kind("raw_acc_gyr_mag_temperature_signed", whole=">10h"),
    0xA020: Kind("raw_gyroscope_temperatures", whole=">3H"),
    0xA021: Kind("raw_gyroscope_temperatures_signed", whole=">3h"),
    0xA030: Kind("raw_acceleration", whole=">3H"),
    0xA040: Kind("raw_rate_of_turn", whole=">3H"),
    0xA050: Kind("raw_magnetic_field", whole=">3H"),
    0xA060: Kind("raw_delta_q"),
    0xA070: Kind("raw_delta_v"),
    0xA080: Kind("raw_blob"),
    0xB010: Kind("analog_in_1", whole=">H"),
    0xB020: Kind("analog_in_2", whole=">H"),
    0xC020: Kind("magnetic_field_au", 3),
    0xC810: Kind("awinda_snapshot"),
    0xC820: Kind("full_snapshot"),
    0xD010: Kind("velocity_m_s", 3),
    0xE010: Kind("status_byte", whole=">B"),
    0xE020: Kind("status_word", whole=">I"),
    0xE040: Kind("signal_strength", whole=">b"),
    0xE080: Kind("device_id", whole=">I"),
}
"""Every identifier of the vendor's list, its last four bits zero for real numbers."""

_WORLDS = ("ENU", "NED", "NWU")


def kind_of(identifier: int) -> Kind | None:
    """Meaning of `identifier` in any format and world; None if it is not known."""
    exact = KINDS.get(identifier)
    general = KINDS.get(identifier & 0xFFF0)
    return exact if exact else general if general and general.reals and identifier & 0xC != 0xC else None


def name_of(identifier: int) -> str:
    """Name of an item; the identifier in hexadecimal if it is not known."""
    kind = kind_of(identifier)
    return kind.name if kind else f"{identifier:#06x}"


def number_format(identifier: int) -> NumberFormat:
    """Format of an item's real numbers."""
    return NumberFormat(identifier & 3)


def world_of(identifier: int) -> str:
    """World of an orientation or velocity: ENU, NED or NWU."""
    code = (identifier >> 2) & 3
    if code >= len(_WORLDS):
        raise InvalidInputError(f"identifier {identifier:#06x}: expected world 0, 1 or 2, got {code}")
    return _WORLDS[code]


@dataclass(frozen=True)
class Item:
    """One item of a message.

    Attributes
    ----------
    identifier : int
    values : tuple of float, tuple of int, or bytes
        Real numbers or whole numbers by `kind_of`; bytes if the item is not understood.
    """

    identifier: int
    values: tuple[float, ...] | tuple[int, ...] | bytes

    @property
    def name(self) -> str:
        """Name of the item; the identifier in hexadecimal if it is not known."""
        return name_of(self.identifier)


def size_of(identifier: int) -> int | None:
    """Bytes of an item's data; None if the length is not fixed."""
    kind = kind_of(identifier)
    if kind is None or not (kind.reals or kind.whole):
        return None
    return kind.reals * number_format(identifier).size if kind.reals else struct.calcsize(kind.whole)


def parts(payload: bytes) -> Iterator[tuple[int, int, int]]:
    """Identifier, and first byte and size of the data, of each item in a payload.

    Raises
    ------
    InvalidInputError
        If an item claims more bytes than are left.
    """
    at = 0
    while at < len(payload):
        size = payload[at + 2] if at + 2 < len(payload) else 0
        if at + 3 + size > len(payload):
            raise InvalidInputError(
                f"MTData2: expected an item of {3 + size} bytes at byte {at}, got {len(payload) - at}"
            )
        yield payload[at] << 8 | payload[at + 1], at + 3, size
        at += 3 + size


def decode_items(payload: bytes) -> list[Item]:
    """Items of a payload, in its order.

    Raises
    ------
    InvalidInputError
        If an item claims more bytes than are left.
    """
    return [Item(i, _decoded(i, payload[at : at + size])) for i, at, size in parts(payload)]


def _decoded(identifier: int, data: bytes) -> tuple[float, ...] | tuple[int, ...] | bytes:
    kind = kind_of(identifier)
    if kind is None or len(data) != size_of(identifier):
        return data
    if kind.whole:
        return struct.unpack(kind.whole, data)
    row = np.frombuffer(data, dtype=np.uint8)[None]
    return tuple(numbers_from_bytes(row, number_format(identifier))[0].tolist())


# -- many messages at once

Arrangement = tuple[tuple[int, int], ...]
"""Identifier and first byte of each wanted item."""

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


def columns(frames: Frames, wanted: frozenset[str]) -> tuple[dict[int, Column], int]:
    """Numbers of the `wanted` items by identifier, and how many messages are damaged.

    Parameters
    ----------
    frames : Frames
        MTData2 messages.
    wanted : frozenset of str
        Names of items whose numbers are all of one type.
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
    """Arrangements (None if damaged) and the indices of the payloads, all of one length, that have them."""
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
    """Mark payloads with the first one's identifiers and sizes; without items, the first alone."""
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
    return tuple((i, at) for i, at, size in items if name_of(i) in wanted and size == size_of(i))


def _numbers(identifier: int, payloads: ByteArray, at: int) -> FloatArray:
    size = size_of(identifier)
    kind = kind_of(identifier)
    assert size is not None  # _wanted passes only items of fixed size
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
