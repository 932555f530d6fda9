"""Decode the self-describing data message MTData2: items of identifier, size and data.

The last four bits of an identifier give the format of its real numbers and their world: ENU, NED or NWU.
Items without a measurement or a time stamp, or of another length than they should have, are passed over.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from speckle3d.core.arrays import BoolArray
from xsens.messages.framing import Frames, rows_at
from xsens.messages.mtdata import REAL, Field, Values, as_floats

KINDS = {
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
"""Identifiers of the vendor's list that are read, their last four bits zero for real numbers."""

_WORLDS = ("ENU", "NED", "NWU")


def kind_of(identifier: int) -> Field | None:
    """Meaning of `identifier` in any format and world; None if it is not read."""
    general = KINDS.get(identifier & 0xFFF0)
    return general if general and not general.whole and identifier & 0xC != 0xC else KINDS.get(identifier)


class Items(NamedTuple):
    """Numbers of m messages by name, shape (m, count), NaN where missing.

    `world` is that of the orientations, "" without; `is_sample` marks messages with more than time stamps,
    `damage` those whose last item claims more bytes than there are: of them nothing is read.
    """

    values: Values
    world: str
    is_sample: BoolArray
    damage: BoolArray


def read_items(frames: Frames) -> Items:
    """Take all messages apart side by side: their first items, their second ones, and so on.

    Orientations in another world than the first are left out.
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
            if (kind := kind_of(identifier)) is None:
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
    return Items(values, world, is_sample, damage)
