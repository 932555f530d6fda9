"""Read tables of numbers in text: names of columns, perhaps with units, to columns in SI units.

Cells without a number are NaN, lines of another length are left out.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.constants import g

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

Names = tuple[str, ...]

_SEPARATORS = ("\t", ";", ",", None)
"""In order of trust: a tab only separates, a comma may be a decimal point, blanks (None) may be padding."""

_LONGEST_HEADER = 64
"""Lines, not counting comments, among which the names of the columns or the first numbers must be."""

_COMMENT = "#"
_DIGIT = re.compile("[0-9]")
_LIKE_NAMES = re.compile(r"(?:[a-z°²µ_][\w .()\[\]/^°²µ-]*|)$")
_AXES = frozenset("wxyzs")
"""Second line of names; s is the unit of a time."""

# -- names of columns

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


def column_of(name: str) -> tuple[str, float | None] | None:
    """Key of a column by its name in lower case; None if it is not understood.

    With it comes what turns its numbers to SI units, None if the name states no unit.
    """
    if match := _VECTOR.match(name):
        quantity, axis, unit = match.groups()
        unit = re.sub(r"[/^*·. ]+", "_", unit.replace("²", "2").replace("^2", "2")).strip("_")
        if unit and unit not in _UNITS[quantity]:
            return None
        return f"{quantity}_{axis}", _UNITS[quantity][unit] if unit else None
    if match := _TIME.match(name):
        return ("time", _UNITS["time"][match[1]]) if match[1] in _UNITS["time"] else None
    for key, pattern in _OTHERS:
        if match := pattern.match(name):
            parts = filter(None, match.groups())
            return key.format(*(_SAME.get(key, {}).get(part, part) for part in parts)), None
    return None


def not_understood(names: Iterable[str]) -> str:
    """Sentence on names of columns, with some of those that are understood."""
    names = list(names)
    more = f" and {len(names) - 9} more" if len(names) > 9 else ""
    listed = ", ".join(name[:40] for name in names[:9])
    return f"columns not understood: {listed}{more} (expected time_s, acc_x, gyr_x_rad_s, mag_x)"


# -- tables


@dataclass(frozen=True)
class TextTable:
    """A table of numbers: the lines before it, names in lower case, and the columns that are understood.

    `columns` are in SI units by key, without blank ones, those of `stated` by a unit in their name; where no
    column has a name, `rows` has all cells. `notes` count lines of another length than the first or without a
    digit, and cells that hold no number.
    """

    header: Names
    names: Names
    columns: dict[str, FloatArray]
    stated: frozenset[str]
    rows: FloatArray
    notes: Names = ()


def read_table(lines: Iterable[str]) -> TextTable:
    """Find the table in some lines and read it.

    Names may be in one line, or in two: ``Acceleration;;;Field`` above ``X;Y;Z;X`` names ``acceleration_x``.
    A line that holds two known names at least is the line of names.

    Raises
    ------
    InvalidInputError
        If there is no table, a quantity has two columns, or its rows are of several sensors.
    """
    lines, header, count = iter(lines), [""], 0
    for line in lines:
        comment = line.startswith(_COMMENT)
        for separator in () if comment else _SEPARATORS:
            cells, above = _cells(line, separator), _cells(header[-1], separator)
            for names in (cells, _of_two_lines(above, cells)):
                if sum(column_of(name) is not None for name in names) >= 2:
                    return _named(lines, tuple(header[1:]), names, separator)
            if len(cells) >= 4 and all(cell == "nan" or number(cell) == number(cell) for cell in cells):
                for split in _SEPARATORS:  # a line above numbers may name their columns
                    names = tuple(cell.strip(' "#') for cell in _cells(header[-1], split))
                    if len(names) == len(cells) and any(names) and all(map(_LIKE_NAMES.match, names)):
                        raise InvalidInputError(not_understood(names))
                return _rows(chain([line], lines), tuple(header[1:]), (), separator, len(cells))
        header.append(line.rstrip("\n"))
        count += not comment
        if count > _LONGEST_HEADER:
            break
    raise InvalidInputError("expected a table of numbers, got none")


def number(cell: str) -> float:
    """The number in a cell, whose decimal point may be a comma; NaN if it is none."""
    try:
        return float(cell.strip().strip('"').replace(",", "."))
    except ValueError:
        return float("nan")


def _cells(line: str, separator: str | None) -> Names:
    return tuple(cell.strip().strip('"').lower() for cell in line.split(separator))


def _of_two_lines(groups: Names, axes: Names) -> Names:
    """Names of columns whose group is in the line above, at the first of its axes; empty if they are not."""
    if len(groups) != len(axes) or not _AXES & set(axes):
        return ()
    names, group = list[str](), ""
    for above, axis in zip(groups, axes, strict=True):
        group = above or group
        names.append(f"{group}_{axis}" if axis in _AXES else above)
    while not names[-1]:  # what a separator at the end of the line makes
        names.pop()
    return tuple(names)


def _named(lines: Iterator[str], header: Names, names: Names, separator: str | None) -> TextTable:
    first = next((line for line in lines if line.strip("\r\n") and _DIGIT.search(line)), "")
    blanks = tuple(part for name in names for part in name.split())
    if len(names) != len(_cells(first, separator)) == len(blanks):  # a blank where a tab should be
        names = blanks
    keys: dict[str, str] = {}
    for name in names:
        key = (column_of(name) or ("",))[0]
        if key not in ("", "counter") and key in keys:
            raise InvalidInputError(
                f"expected the columns of one sensor, got two of {key}: {keys[key]}, {name}"
            )
        keys[key] = name
    return _rows(chain([first], lines), header, names, separator, len(names))


def _rows(lines: Iterable[str], header: Names, names: Names, separator: str | None, count: int) -> TextTable:
    """Read the columns that are understood, or all if none has a name."""
    known = {i: column for i, name in enumerate(names) if (column := column_of(name)) is not None}
    kept = list(known) or range(count)
    sensors = {i: dict[str, None]() for i, name in enumerate(names) if _WHOSE.match(name)}
    values, left_out, words = array("d"), 0, 0
    for line in lines:
        if not line.strip("\r\n"):
            continue
        cells = (line if separator == "," else line.replace(",", ".")).split(separator)
        if len(cells) != count or not _DIGIT.search(line):
            left_out += 1
            continue
        for i, ids in sensors.items():
            ids[cells[i].strip()] = None
        try:
            values.extend([float(cells[i]) for i in kept])
        except ValueError:  # quoted, blank, or a word
            row = [number(cells[i]) for i in kept]
            blank = [cells[i].strip().lower() in ("", "nan") for i in kept]
            words += int(np.sum(np.isnan(row) & ~np.array(blank)))
            values.extend(row)
    if not values:
        raise InvalidInputError(
            f"expected lines of {count} cells below the names, got {left_out} lines of another length"
        )
    for i, ids in sensors.items():
        if len(ids) > 1:
            listed = ", ".join(list(ids)[:4])
            raise InvalidInputError(
                f"column {names[i]}: expected rows of one sensor, got {len(ids)} ({listed}): split the table"
            )
    notes = []
    if left_out:
        notes.append(f"{left_out} lines of another length or without a digit were left out")
    if words:
        notes.append(f"{words} cells hold something else than a number: missing")
    rows = np.frombuffer(values).reshape(-1, len(kept))
    with np.errstate(over="ignore"):  # damage, which is left out as no measurement
        columns = {
            key: column * (scale or 1.0)
            for (key, scale), column in zip(known.values(), rows.T, strict=False)
            if np.isfinite(column).any()
        }
    stated = frozenset(key for key, scale in known.values() if scale is not None)
    return TextTable(header, names, columns, stated, rows, tuple(notes))
