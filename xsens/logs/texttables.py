"""Read tables of numbers in text: cells without a number are NaN, lines of another length are left out."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.columns import Column, Names, column_of, names_a_sensor, suggestion

_SEPARATORS = ("\t", ";", ",", None)
"""In order of trust: a tab only separates, a comma may be a decimal point, blanks (None) may be padding."""

_LONGEST_HEADER = 64
"""Lines, not counting comments, among which the names of the columns or the first numbers must be."""

_COMMENT = "#"
_BLANK = ("", "nan", "NaN")
_DIGIT = re.compile("[0-9]")
_LIKE_NAMES = re.compile(r"(?:[a-z°²µ_][\w .()\[\]/^°²µ-]*|)$")
_AXES = frozenset("wxyzs")
"""Second line of names; s is the unit of a time."""


@dataclass(frozen=True)
class TextTable:
    """A table of numbers: the lines before it, names in lower case, and the columns that are understood.

    `values` has a column for each of `columns`, or for each cell where none has a name. `left_out` counts
    lines of another length than the first or without a digit, `words` other cells that hold no number.
    """

    header: Names
    names: Names
    columns: tuple[Column, ...]
    values: FloatArray
    left_out: int = 0
    words: int = 0

    def column(self, key: str) -> FloatArray | None:
        """Numbers of the column, shape (rows,); None if there is none, or it is blank."""
        at = next((i for i, column in enumerate(self.columns) if column.key == key), None)
        return None if at is None or not np.isfinite(self.values[:, at]).any() else self.values[:, at]

    def group(self, pattern: str, axes: Iterable[str]) -> FloatArray | None:
        """Columns side by side, shape (rows, axes); None if one is missing."""
        columns = [column for axis in axes if (column := self.column(pattern.format(axis))) is not None]
        return np.stack(columns, axis=1) if len(columns) == len(tuple(axes)) else None

    def scale(self, key: str) -> float | None:
        """Factor to SI units that the column's name states; None if it states none."""
        return next((column.scale for column in self.columns if column.key == key), None)


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
        if not line.startswith(_COMMENT):
            for separator in _SEPARATORS:
                cells = _cells(line, separator)
                for names in (cells, _of_two_lines(_cells(header[-1], separator), cells)):
                    if sum(column_of(name) is not None for name in names) >= 2:
                        return _named(chain(lines), header, names, separator)
                if len(cells) >= 4 and all(map(_is_number, cells)):
                    _refuse_unknown_names(header[-1], len(cells))
                    return _rows(chain([line], lines), header, (), (), separator, len(cells))
        header.append(line.rstrip("\n"))
        count += not line.startswith(_COMMENT)
        if count > _LONGEST_HEADER:
            break
    raise InvalidInputError("expected a table of numbers, got none")


def _cells(line: str, separator: str | None) -> Names:
    return tuple(cell.strip().strip('"').lower() for cell in line.split(separator))


def _is_number(cell: str) -> bool:
    return cell == "nan" or not np.isnan(number(cell.replace(",", ".")))


def _of_two_lines(groups: Names, axes: Names) -> Names:
    """Names of columns whose group is in the line above, at the first of its axes; empty if they are not."""
    if len(groups) != len(axes) or not _AXES & set(axes):
        return ()
    names, group, last = [], "", 0
    for at, (above, axis) in enumerate(zip(groups, axes, strict=True)):
        group = above or group
        names.append(f"{group}_{axis}" if axis in _AXES else group)
        last = at + 1 if above or axis else last
    return tuple(names[:last])  # without what a separator at the end of the line makes


def _refuse_unknown_names(line: str, count: int) -> None:
    """Raise if a line above numbers names their columns, none of them by a name that is understood."""
    for separator in ("\t", ";", ",", None):
        names = tuple(cell.strip(' "#') for cell in _cells(line, separator))
        if len(names) == count and sum(map(bool, names)) > 1 and all(map(_LIKE_NAMES.match, names)):
            listed = ", ".join(map(suggestion, names))
            raise InvalidInputError(f"columns not understood: {listed}")


def _named(lines: Iterator[str], header: list[str], names: Names, separator: str | None) -> TextTable:
    first = next((line for line in lines if line.strip("\r\n") and _DIGIT.search(line)), "")
    if len(_cells(first, separator)) != len(names):  # a blank where a tab should be, or the like
        blanks = tuple(part for name in names for part in name.split())
        names = blanks if len(blanks) == len(_cells(first, separator)) else names
    columns = [column_of(name) for name in names]
    keys = [column.key for column in columns if column is not None and column.key != "counter"]
    if twice := next((key for key in keys if keys.count(key) > 1), None):
        both = [name for name in names if (column := column_of(name)) and column.key == twice]
        raise InvalidInputError(f"expected the columns of one sensor, got two of {twice}: {', '.join(both)}")
    return _rows(chain([first], lines), header, names, tuple(columns), separator, len(names))


def _rows(
    lines: Iterable[str],
    header: list[str],
    names: Names,
    columns: tuple[Column | None, ...],
    separator: str | None,
    count: int,
) -> TextTable:
    """Read the columns that are understood, or all if none has a name."""
    known = {i: column for i, column in enumerate(columns) if column is not None}
    kept = list(known) or range(count)
    sensors = {name: dict[str, None]() for name in names if names_a_sensor(name)}
    values, left_out, words = array("d"), 0, 0
    for line in lines:
        if not line.strip("\r\n"):
            continue
        cells = (line if separator == "," else line.replace(",", ".")).split(separator)
        if len(cells) != count or not _DIGIT.search(line):
            left_out += 1
            continue
        for name, ids in sensors.items():
            ids[cells[names.index(name)].strip()] = None
        try:
            values.extend([float(cells[i]) for i in kept])
        except ValueError:  # quoted, blank, or a word
            row = [number(cells[i]) for i in kept]
            words += sum(v != v and cells[i].strip() not in _BLANK for i, v in zip(kept, row, strict=True))
            values.extend(row)
    if not values:
        raise InvalidInputError(
            f"expected lines of {count} cells below the names, got {left_out} lines of another length"
        )
    for name, ids in sensors.items():
        if len(ids) > 1:
            listed = ", ".join(list(ids)[:4]) + (", ..." if len(ids) > 4 else "")
            raise InvalidInputError(
                f"column {name}: expected rows of one sensor, got {len(ids)} ({listed}): split the table"
            )
    rows = np.frombuffer(values).reshape(-1, len(kept))
    return TextTable(tuple(header[1:]), names, tuple(known.values()), rows, left_out, words)


def number(cell: str) -> float:
    """The number in a cell; NaN if it is none."""
    try:
        return float(cell.strip().strip('"'))
    except ValueError:
        return float("nan")
