"""Read tables of numbers in text: cells without a number are NaN, lines of another length are left out."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

SEPARATORS = ("\t", ";", ",", " ")
"""In order of trust: a tab only separates, a comma may be a decimal point, a space may be padding."""

_LONGEST_HEADER = 64
"""Lines, not counting comments, among which the names of the columns or the first numbers must be."""

_COMMENT = "#"
_LONGEST_LINE = 1 << 16
_MOST_COLUMNS = 256
_DIGIT = re.compile("[0-9]")
_AXES = frozenset("wxyz")

Names = tuple[str, ...]


@dataclass(frozen=True)
class TextTable:
    """A table of numbers, and the lines before it.

    Attributes
    ----------
    header : tuple of str
        Lines before the table, without the lines of names.
    names : tuple of str
        Names of all columns, in lower case; empty if there are none.
    kept : tuple of str
        Names of the columns in `values`: those that are known.
    values : ndarray, shape (rows, columns)
    left_out : int
        Lines of another length than the first, or without a digit.
    words : int
        Cells that hold something else than a number.
    """

    header: Names
    names: Names
    kept: Names
    values: FloatArray
    left_out: int = 0
    words: int = 0

    def column(self, name: str) -> FloatArray | None:
        """The column called `name`, shape (rows,); None if there is none, or it is blank."""
        if name not in self.kept:
            return None
        values = self.values[:, self.kept.index(name)]
        return values if np.isfinite(values).any() else None

    def columns(self, *names: str) -> FloatArray | None:
        """Columns side by side, shape (rows, len(names)); None if one is missing."""
        found = [self.column(name) for name in names]
        there = [column for column in found if column is not None]
        return np.stack(there, axis=1) if len(there) == len(found) else None

    def first(self, groups: Iterable[Names]) -> FloatArray | None:
        """Columns of the first group of names of which none is missing; None if there is no such group."""
        return next((found for names in groups if (found := self.columns(*names)) is not None), None)


def read_table(lines: Iterable[str], known: frozenset[str]) -> TextTable:
    """Find the table in some lines and read it.

    Names may be in one line, or in two: ``Acceleration;;;Field`` above ``X;Y;Z;X`` names ``acceleration_x``.

    Parameters
    ----------
    lines : iterable of str
    known : frozenset of str
        Names of columns, in lower case; a line that holds at least two of them is the line of names.

    Raises
    ------
    InvalidInputError
        If there is no table.
    """
    lines = iter(lines)
    header: list[str] = []
    seen = 0
    for line in lines:
        found = _begins_table(line, header[-1] if header else "", known)
        if found is not None:
            separator, names, count = found
            rows = _Rows(lines if names else chain([line], lines), separator, count)
            return _table(rows, tuple(header), names, known)
        header.append(line.rstrip("\n")[:_LONGEST_LINE])
        seen += not line.startswith(_COMMENT)
        if seen > _LONGEST_HEADER:
            break
    raise InvalidInputError("expected a table of numbers, got none")


def _begins_table(line: str, above: str, known: frozenset[str]) -> tuple[str, Names, int] | None:
    """Separator, names and number of the columns, if `line` holds their names or the first numbers."""
    if len(line) > _LONGEST_LINE or line.startswith(_COMMENT):
        return None
    for separator in SEPARATORS:
        cells = _cells(line, separator)
        for names in (cells, _of_two_lines(_cells(above, separator), cells)):
            if len(known & set(names)) >= 2:
                return separator, names, len(names)
        if len(cells) >= 4 and all(map(_is_number, cells)):
            return separator, (), len(cells)
    return None


def _cells(line: str, separator: str) -> Names:
    cells = line.split(None if separator == " " else separator)
    return tuple(cell.strip().strip('"').lower() for cell in cells)


def _is_number(cell: str) -> bool:
    return cell == "nan" or not np.isnan(number(cell.replace(",", ".")))


def _of_two_lines(groups: Names, axes: Names) -> Names:
    """Names of columns whose group is in the line above, at the first of its axes; empty if they are not."""
    if len(groups) != len(axes) or not _AXES & set(axes):
        return ()
    names, group = [], ""
    for above, axis in zip(groups, axes, strict=True):
        group = above or group
        names.append(f"{group}_{axis}" if axis in _AXES or axis == "s" else group)
    while names and not axes[len(names) - 1] and not groups[len(names) - 1]:
        names.pop()  # a separator at the end of the lines of names alone
    return tuple(names)


class _Rows:
    """Lines of as many cells as the table has columns; counts what it leaves out."""

    def __init__(self, lines: Iterable[str], separator: str, count: int) -> None:
        self._lines, self.separator, self.count = lines, separator, count
        self.left_out = self.words = 0

    def __iter__(self) -> Iterator[str]:
        for line in self._lines:
            if not line.strip("\r\n"):
                continue
            blank = self.separator == " "
            cells = len(line.split()) if blank else line.count(self.separator) + 1
            if cells != self.count or not _DIGIT.search(line):
                self.left_out += 1
            else:
                yield line if self.separator == "," else line.replace(",", ".")

    def number(self, cell: str) -> float:
        """The number in a cell, or NaN; words are counted."""
        value = number(cell)
        if value != value and cell.strip() and cell.strip().lower() != "nan":
            self.words += 1
        return value


def _table(rows: _Rows, header: Names, names: Names, known: frozenset[str]) -> TextTable:
    if rows.count > _MOST_COLUMNS:
        raise InvalidInputError(f"expected a table of at most {_MOST_COLUMNS} columns, got {rows.count}")
    kept = tuple(dict.fromkeys(name for name in names if name in known))
    which = [names.index(name) for name in kept] if names else None
    first = next(iterator := iter(rows), None)
    if first is None:
        got = f"{rows.left_out} others" if rows.left_out else "none"
        raise InvalidInputError(f"expected lines of {rows.count} numbers, got {got}")
    delimiter = None if rows.separator == " " else rows.separator
    values = np.loadtxt(
        chain([first], iterator),
        delimiter=delimiter,
        comments=None,
        converters=rows.number,
        usecols=which,
        ndmin=2,
        encoding=None,
    )
    return TextTable(header, names, kept, values, rows.left_out, rows.words)


def number(cell: str) -> float:
    """The number in a cell; NaN if it is none."""
    try:
        return float(cell.strip().strip('"'))
    except ValueError:
        return float("nan")
