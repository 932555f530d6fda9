"""Decode data messages: legacy MTData, and MTData2, which describes itself.

MTData's layout is by output mode and settings, known from the configuration or from whoever set them; the
MT9-B puts the counter first instead of last. MTData2 has items of identifier, size and data: the last four
bits of an identifier give the format of its real numbers and their world, ENU, NED or NWU. Items without a
measurement or a time stamp, or of another length than they should have, are passed over.
"""

from dataclasses import dataclass
from enum import IntFlag
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.messages.framing import Frames, rows_at

Values = dict[str, FloatArray]
"""Field name to values, shape (n, count); whole numbers are exact."""

REAL = (">f4", ">i4", ">u4,>i2", ">f8")
"""NumPy types of real numbers by the vendor's two-bit fields; all values are exact as float64.

The second is over 2**20; the third a 48-bit integer over 2**32, its fraction before its whole part.
"""


def as_floats(numbers: NDArray[Any]) -> FloatArray:
    """Float64 of numbers of one of the types in `REAL`, or of unsigned whole numbers."""
    if numbers.dtype == REAL[1]:
        return numbers / 2.0**20
    if numbers.dtype == np.dtype(REAL[2]):
        return numbers["f1"] + numbers["f0"] / 2.0**32
    with np.errstate(invalid="ignore"):  # signalling NaNs, which damage can make
        return numbers.astype(np.float64)


class OutputMode(IntFlag):
    """Parts that are asked for or told apart; all are in `_PARTS`."""

    CALIBRATED = 0x0002
    ORIENTATION = 0x0004
    RAW = 0x4000
    MT9 = 0x8000
    """The MT9-B's raw record, which begins with the counter."""


class OutputSettings(IntFlag):
    """Options; orientation and number format are fields of two bits, see `DataLayout`."""

    COUNTER = 0x1
    UTC = 0x2
    NED = 0x80000000


@dataclass(frozen=True)
class Field:
    """A run of values in a message, of a NumPy type; an empty one is real, in the message's format."""

    name: str
    count: int
    whole: str = ""


_RAW = (
    Field("raw_accelerometer", 3, ">u2"),
    Field("raw_gyroscope", 3, ">u2"),
    Field("raw_magnetometer", 3, ">u2"),
    Field("raw_temperature", 1, ">u2"),
)
_COUNTER = Field("counter", 1, ">u2")
_ORIENTATION = (Field("quaternion_wxyz", 4), Field("euler_deg", 3), Field("matrix", 9), None)
_PARTS = (
    (0x0001, 0, Field("temperature_c", 1)),
    (OutputMode.CALIBRATED, 0x10, Field("accelerometer_m_s2", 3)),
    (OutputMode.CALIBRATED, 0x20, Field("gyroscope_rad_s", 3)),
    (OutputMode.CALIBRATED, 0x40, Field("magnetometer_au", 3)),
    (OutputMode.ORIENTATION, 0, None),
    (0x0008, 0x400, Field("analog_1", 1, ">u2")),
    (0x0008, 0x800, Field("analog_2", 1, ">u2")),
    (0x0010, 0, Field("position", 3)),
    (0x0020, 0, Field("velocity_m_s", 3)),
    (0x0800, 0, Field("status", 1, ">u1")),
)
"""Bit of the mode, the setting that leaves the field out, and the field (None: by the settings), in order."""


@dataclass(frozen=True)
class DataLayout:
    """Order of the fields in an MTData payload.

    Attributes
    ----------
    mode, settings : int
        See `OutputMode` and `OutputSettings`; bits 2 and 3 of the settings choose quaternion, Euler angles or
        matrix, bits 8 and 9 the type of real numbers (`REAL`).

    Raises
    ------
    InvalidInputError
        If mode or settings are not possible, or leave no field.
    """

    mode: int
    settings: int = OutputSettings.COUNTER

    def __post_init__(self) -> None:
        if (self.settings >> 2) & 3 == 3 or not self.fields:
            raise InvalidInputError(
                f"expected output mode and settings of some known output, got {self.mode:#x}, "
                f"{self.settings:#x}"
            )

    @property
    def frame(self) -> str:
        """World of the orientation: NED if that is set, else NWU."""
        return "NED" if self.settings & OutputSettings.NED else "NWU"

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """Fields in the order of the message."""
        if self.mode == OutputMode.MT9:
            return (_COUNTER, *_RAW)
        counter = (_COUNTER,) if self.settings & OutputSettings.COUNTER else ()
        utc = (Field("utc", 12, ">u1"),) if self.settings & OutputSettings.UTC else ()
        orientation = _ORIENTATION[(self.settings >> 2) & 3]
        calibrated = (
            field or orientation
            for part, off, field in _PARTS
            if self.mode & part and not self.settings & off
        )
        return (*(_RAW if self.mode == OutputMode.RAW else calibrated), *counter, *utc)

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The payload as a NumPy structure."""
        real = REAL[(self.settings >> 8) & 3]
        return np.dtype([(field.name, field.whole or real, (field.count,)) for field in self.fields])

    def decode(self, frames: Frames, name: str) -> NDArray[Any]:
        """Numbers of a field in messages of this layout, shape (n, count); for `as_floats`."""
        kind, offset = self.dtype.fields[name][:2]  # type: ignore[index]
        return rows_at(frames.data, frames.payload_start + offset, kind.itemsize).view(kind.base)


# -- MTData2

_ITEMS = {
    0x1020: Field("counter", 1, ">u2"),
    0x1060: Field("ticks", 1, ">u4"),
    0x2010: Field("quaternion_wxyz", 4),
    0x2020: Field("matrix", 9),
    0x2030: Field("euler_deg", 3),
    0x4010: Field("delta_v_m_s", 3),
    0x4020: Field("accelerometer_m_s2", 3),
    0x8020: Field("gyroscope_rad_s", 3),
    0x8030: Field("delta_q_wxyz", 4),
    0xC020: Field("magnetometer_au", 3),
}
"""Identifiers of the vendor's list that are read."""

KINDS = {first + k: kind for first, kind in _ITEMS.items() for k in range(1 if kind.whole else 12)}
"""Those of all formats (two bits) and worlds (two above them) of real numbers as well."""

_WORLDS = ("ENU", "NED", "NWU")


def read_items(frames: Frames) -> tuple[Values, str, BoolArray, BoolArray]:
    """Take all messages apart side by side: their first items, their second ones, and so on.

    Orientations in another world than the first are left out.

    Returns
    -------
    mapping of str to ndarray, shape (m, count)
        Numbers of the m messages by name, NaN where missing.
    str
        World of the orientations, "" without.
    ndarray of bool, shape (m,)
        Messages with more than time stamps.
    ndarray of bool, shape (m,)
        Damage: those whose last item claims more bytes than there are. Of them nothing is read.
    """
    values: Values = {}
    world = ""
    is_sample, damage = np.zeros((2, len(frames)), dtype=bool)
    data, rows, at, end = frames.data, np.arange(len(frames)), frames.payload_start, frames.end - 1
    while (left := at < end).any():
        rows, at, end = rows[left], at[left], end[left]
        identifiers = rows_at(data, at, 2).view(">u2")[:, 0]
        sizes = data.take(at + 2, mode="clip")  # behind a last identifier the data may end
        after = at + 3 + sizes
        damage[rows[after > end]] = True
        for identifier in np.unique(identifiers).tolist():
            if (kind := KINDS.get(identifier)) is None:
                continue
            number = np.dtype(kind.whole or REAL[identifier & 3])
            size = kind.count * number.itemsize
            matches = (identifiers == identifier) & (sizes == size) & (after <= end)
            if not matches.any():
                continue
            is_sample[rows[matches]] |= not kind.whole
            if identifier >> 12 == 2:  # an orientation
                frame = _WORLDS[identifier >> 2 & 3]
                world = world or frame
                if frame != world:
                    continue
            if kind.name not in values:
                values[kind.name] = np.full((len(frames), kind.count), np.nan)
            values[kind.name][rows[matches]] = as_floats(rows_at(data, at[matches] + 3, size).view(number))
        at = after
    is_sample &= ~damage
    if "matrix" in values:  # sent column by column
        values["matrix"] = values["matrix"].reshape(-1, 3, 3).swapaxes(1, 2).reshape(-1, 9)
    for column in values.values():
        column[damage] = np.nan
    return values, world, is_sample, damage
