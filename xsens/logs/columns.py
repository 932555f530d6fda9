"""Names of columns in text logs: the quantity, its axis, and the unit that the name states."""

from __future__ import annotations

import re
from typing import NamedTuple

from scipy.constants import g


class Column(NamedTuple):
    """Meaning of a column; `scale` turns its numbers to SI units, None if the name states no unit."""

    key: str
    scale: float | None = None


_DEG = 0.017453292519943295
_UNITS = {
    "acc": {"m_s2": 1.0, "m_s_s": 1.0, "g": g, "mg": 1e-3 * g},
    "gyr": {"rad_s": 1.0, "deg_s": _DEG, "dps": _DEG, "°_s": _DEG, "mdps": 1e-3 * _DEG, "mrad_s": 1e-3},
    "mag": dict.fromkeys(("au", "a_u", "ut", "µt", "nt", "mt", "t", "gauss", "g", "mgauss"), 1.0),
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
}
"""Units by quantity; the field stays in the unit it is in."""

_VECTOR = re.compile(r"(?:imu )?(acc|gyr|mag)[a-z ]*[ _.]?([xyz])(?![a-z])\W*_?(.*?)\W*$", re.ASCII)
_TIME = re.compile(r"time(?:[ _]?stamp)?[ _(\[/]+([a-zµ]+)[)\]]?$")
_OTHERS = (
    ("counter", re.compile(r"(?:packet)?counter$")),
    ("ticks", re.compile(r"sampletimefine$")),
    ("quat_{}", re.compile(r"quat(?:ernion)?_(?:q)?([wxyz0-3])$")),
    ("optical_{}", re.compile(r"vicon orientation_([wxyz])$")),
    ("euler_{}", re.compile(r"euler_([xyz])$|(roll|pitch|yaw)$")),
    ("mat_{}{}", re.compile(r"mat\[([1-3])\]\[([1-3])\]$")),
)
_SAME = {
    "quat_{}": {"0": "w", "1": "x", "2": "y", "3": "z"},
    "euler_{}": {"x": "roll", "y": "pitch", "z": "yaw"},
}
"""Names of one axis."""

_WHOSE = re.compile(
    r"(?:sensor|device|imu|node|unit)[ _]?(?:id|name|no|nr|number|tag|serial)?$"
    r"|(?:id|tag|mac(?:[ _]?address)?|serial(?:[ _]?number)?)$"
)
"""Names of columns that say which sensor a row is of."""


def column_of(name: str) -> Column | None:
    """Meaning of a column by its name in lower case; None if it is not understood."""
    if match := _VECTOR.match(name):
        quantity, axis, unit = match.groups()
        unit = re.sub(r"[/^*·. ]+", "_", unit.replace("²", "2").replace("^2", "2")).strip("_")
        if unit and unit not in _UNITS[quantity]:
            return None
        return Column(f"{quantity}_{axis}", _UNITS[quantity][unit] if unit else None)
    if match := _TIME.match(name):
        return Column("time", _UNITS["time"][match[1]]) if match[1] in _UNITS["time"] else None
    for key, pattern in _OTHERS:
        if match := pattern.match(name):
            parts = filter(None, match.groups())
            return Column(key.format(*(_SAME.get(key, {}).get(part, part) for part in parts)))
    return None


def names_a_sensor(name: str) -> bool:
    """Whether a column of this name says which sensor a row is of."""
    return _WHOSE.match(name) is not None
