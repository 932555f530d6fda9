"""What the self-describing data message MTData2 carries: items of identifier, size and data.

The last four bits of an identifier say how its real numbers are written and in which world: ENU, NED or NWU.
Items that are not known, or not as long as they should be, are kept as bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from speckle3d.core.errors import InvalidInputError
from xsens.messages.numberformats import NumberFormat, bytes_from_numbers, numbers_from_bytes


@dataclass(frozen=True)
class Kind:
    """What an identifier stands for: `reals` real numbers, or whole numbers packed as `whole`, or bytes."""

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
    """What `identifier` stands for, whatever its format and world; None if it is not known."""
    exact = KINDS.get(identifier)
    general = KINDS.get(identifier & 0xFFF0)
    return exact if exact else general if general and general.reals and identifier & 0xC != 0xC else None


def number_format(identifier: int) -> NumberFormat:
    """How the real numbers of an item are written."""
    return NumberFormat(identifier & 3)


def world_of(identifier: int) -> str:
    """World of an orientation or velocity: ENU, NED or NWU."""
    code = (identifier >> 2) & 3
    if code >= len(_WORLDS):
        raise InvalidInputError(f"identifier {identifier:#06x}: expected world 0, 1 or 2, got {code}")
    return _WORLDS[code]


def identifier_of(name: str, form: NumberFormat = NumberFormat.FLOAT32, world: str = "ENU") -> int:
    """Identifier of the item called `name`, with its format and world where it has any."""
    for identifier, kind in KINDS.items():
        if kind.name == name:
            return identifier | (form | _WORLDS.index(world) << 2 if kind.reals else 0)
    raise InvalidInputError(f"MTData2 item: expected one of {len(KINDS)} names, got {name!r}")


@dataclass(frozen=True)
class Item:
    """One item of a message.

    Attributes
    ----------
    identifier : int
    values : tuple of float, tuple of int, or bytes
        Real numbers, whole numbers, or what is not known, as `kind_of` says.
    """

    identifier: int
    values: tuple[float, ...] | tuple[int, ...] | bytes

    @property
    def name(self) -> str:
        """What it is called; the identifier in hexadecimal if it is not known."""
        kind = kind_of(self.identifier)
        return kind.name if kind else f"{self.identifier:#06x}"


def size_of(identifier: int) -> int | None:
    """Bytes of an item's data; None if they may be any number."""
    kind = kind_of(identifier)
    if kind is None or not (kind.reals or kind.whole):
        return None
    return kind.reals * number_format(identifier).size if kind.reals else struct.calcsize(kind.whole)


def parts(payload: bytes) -> Iterator[tuple[int, int, int]]:
    """Identifier, first byte and size of the data of each item.

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
    """Items of a message, in its order.

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


def encode_items(items: Iterable[Item]) -> bytes:
    """Payload that holds `items`.

    Raises
    ------
    InvalidInputError
        If an item has too many or too few numbers, or one that does not fit.
    """
    return b"".join(map(_encoded, items))


def _encoded(item: Item) -> bytes:
    data = item.values if isinstance(item.values, bytes) else _packed(item, item.values)
    if not 0 <= item.identifier <= 0xFFFF or len(data) > 0xFF:
        raise InvalidInputError(
            f"{item.name}: expected an identifier of 16 bits and at most 255 bytes, got {len(data)} bytes"
        )
    return struct.pack(">HB", item.identifier, len(data)) + data


def _packed(item: Item, values: tuple[float, ...]) -> bytes:
    kind = kind_of(item.identifier)
    if kind is None or not (kind.whole or len(values) == kind.reals):
        raise InvalidInputError(f"{item.name}: expected bytes or {kind.reals if kind else 0} numbers")
    if kind.reals:
        return bytes_from_numbers([values], number_format(item.identifier)).tobytes()
    try:
        return struct.pack(kind.whole, *values)
    except struct.error as error:
        raise InvalidInputError(f"{item.name}: {error}") from error
