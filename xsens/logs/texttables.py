"""Read tables of numbers in text: cells without a number are NaN, lines of another length are left out."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

Names = tuple[str, ...]

_SEPARATORS = ("\t", ";", ",", None)
"""In order of trust: a tab only separates, a comma may be a decimal point, blanks (None) may be padding."""

_LONGEST_HEADER = 64
"""Lines, not counting comments, among which the names of the columns or the first numbers must be."""

_LONGEST_LINE = 1 << 16
_MOST_COLUMNS = 256
_MANY_WORDS = 100_000
_COMMENT = "#"
_DIGIT = re.compile("[0-9]")
_AXES = frozenset("wxyzs")
"""Second line of names; s is the unit of a time."""


@dataclass(frozen=True)
class TextTable:
    """A table of numbers: the lines before it, names in lower case, and its known columns' values.

    `left_out` counts lines of another length than the first or without a digit, `words` other cells that hold
    no number.
    """

    header: Names
    names: Names
    kept: Names
    values: FloatArray
    left_out: int = 0
    words: int = 0

    def column(self, name: str) -> FloatArray | None:
        """The column called `name`, shape (rows,); None if there is none, or it is blank."""
        values = self.values[:, self.kept.index(name)] if name in self.kept else None
        return values if values is not None and np.isfinite(values).any() else None

    def columns(self, names: Names) -> FloatArray | None:
        """Columns side by side, shape (rows, len(names)); None if one is missing."""
        found = [column for name in names if (column := self.column(name)) is not None]
        return np.stack(found, axis=1) if len(found) == len(names) else None

    def first(self, groups: Iterable[Names]) -> FloatArray | None:
        """Columns of the first group of names of which none is missing; None if there is no such group."""
        return next((found for names in groups if (found := self.columns(names)) is not None), None)


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
    lines, header, seen = iter(lines), [""], 0
    for line in lines:
        if len(line) <= _LONGEST_LINE and not line.startswith(_COMMENT):
            for separator in _SEPARATORS:
                cells = _cells(line, separator)
                for names in (cells, _of_two_lines(_cells(header[-1], separator), cells)):
                    if len(known & set(names)) >= 2:
                        return _Rows(separator, len(names)).table(lines, tuple(header[1:]), names, known)
                if len(cells) >= 4 and all(map(_is_number, cells)):
                    rows = _Rows(separator, len(cells))
                    return rows.table(chain([line], lines), tuple(header[1:]), (), known)
        header.append(line.rstrip("\n")[:_LONGEST_LINE])
        seen += not line.startswith(_COMMENT)
        if seen > _LONGEST_HEADER:
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


class _Rows:
    """Lines of as many cells as the table has columns, and counts of what is left out."""

    def __init__(self, separator: str | None, count: int) -> None:
        if count > _MOST_COLUMNS:
            raise InvalidInputError(f"expected a table of at most {_MOST_COLUMNS} columns, got {count}")
        self.separator, self.count = separator, count
        self.left_out = self.words = 0

    def table(self, lines: Iterable[str], header: Names, names: Names, known: frozenset[str]) -> TextTable:
        """Read the table's known columns, or all if they have no names."""
        kept = tuple(dict.fromkeys(name for name in names if name in known))
        rows = self._even(lines, len(kept) or self.count)
        if (first := next(rows, None)) is None:
            raise InvalidInputError(f"expected lines of {self.count} numbers, got {self.left_out} others")
        values = np.loadtxt(
            chain([first], rows),
            delimiter=self.separator,
            comments=None,
            converters=self._number,
            usecols=[names.index(name) for name in kept] or None,
            ndmin=2,
            encoding=None,
        )
        return TextTable(header, names, kept, values, self.left_out, self.words)

    def _even(self, lines: Iterable[str], columns: int) -> Iterator[str]:
        rows = 0
        for line in lines:
            if not line.strip("\r\n"):
                continue
            cells = line.count(self.separator) + 1 if self.separator else len(line.split())
            if cells != self.count or not _DIGIT.search(line):
                self.left_out += 1
                continue
            rows += 1
            if self.words > max(_MANY_WORDS, rows * columns / 2):
                raise InvalidInputError(f"expected numbers, got words in {self.words} cells of {rows} lines")
            yield line if self.separator == "," else line.replace(",", ".")

    def _number(self, cell: str) -> float:
        value = number(cell)
        self.words += value != value and cell.strip().lower() not in ("", "nan")
        return value


def number(cell: str) -> float:
    """The number in a cell; NaN if it is none."""
    try:
        return float(cell.strip().strip('"'))
    except ValueError:
        return float("nan")
