"""Read tables of numbers in text: blank cells are NaN, and lines of another length are left out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

SEPARATORS = ("\t", ";", ",", " ")
"""In order of trust: a tab only separates, a comma may be a decimal point, a space may be padding."""

_LONGEST_HEADER = 64
"""Lines, not counting comments, among which the names of the columns or the first numbers must be."""

_PIECE = 1 << 20
"""Characters read at a time: as lines, and then as numbers, they take several times their memory."""

_COMMENT = "#"
_LONGEST_LINE = 1 << 16
_MOST_COLUMNS = 256


@dataclass(frozen=True)
class TextTable:
    """A table of numbers, and the lines before it.

    Attributes
    ----------
    header : tuple of str
        Lines before the table, without the line of names.
    names : tuple of str
        Names of the columns, in lower case; empty if there are none.
    values : ndarray, shape (rows, columns)
    left_out : int
        Lines of another length than the first.
    """

    header: tuple[str, ...]
    names: tuple[str, ...]
    values: FloatArray
    left_out: int

    def column(self, name: str) -> FloatArray | None:
        """The column called `name`, shape (rows,); None if there is none, or it is blank."""
        if name not in self.names:
            return None
        values = self.values[:, self.names.index(name)]
        return values if np.isfinite(values).any() else None

    def columns(self, *names: str) -> FloatArray | None:
        """Columns side by side, shape (rows, len(names)); None if one is missing."""
        found = [self.column(name) for name in names]
        there = [column for column in found if column is not None]
        return np.stack(there, axis=1) if len(there) == len(found) else None

    def first(self, groups: Iterable[tuple[str, ...]]) -> FloatArray | None:
        """Columns of the first group of names of which none is missing; None if there is no such group."""
        return next((found for names in groups if (found := self.columns(*names)) is not None), None)


def read_table(text: str, known: frozenset[str]) -> TextTable:
    """Find the table in `text` and read it.

    Parameters
    ----------
    text : str
    known : frozenset of str
        Names of columns, in lower case; a line that holds at least two of them is the line of names.

    Raises
    ------
    InvalidInputError
        If there is no table.
    """
    header: list[str] = []
    seen = 0
    for line, start, end in _lines(text):
        found = _begins_table(line, known)
        if found is not None:
            separator, names, count = found
            return _table(text, end if names else start, separator, tuple(header), names, count)
        header.append(line)
        seen += not line.startswith(_COMMENT)
        if seen > _LONGEST_HEADER:
            break
    raise InvalidInputError("expected a table of numbers, got none")


def _lines(text: str) -> Iterator[tuple[str, int, int]]:
    """Lines, with the positions in the text where each and the next begin."""
    at = 0
    while at < len(text):
        end = text.find("\n", at)
        after = end + 1 if end >= 0 else len(text)
        yield text[at:after].strip("\r\n"), at, after
        at = after


def _begins_table(line: str, known: frozenset[str]) -> tuple[str, tuple[str, ...], int] | None:
    """Separator, names and number of the columns, if `line` holds their names or the first numbers."""
    if len(line) > _LONGEST_LINE or line.startswith(_COMMENT):
        return None
    for separator in SEPARATORS:
        cells = _cells(line, separator)
        names = tuple(cell.strip('"').lower() for cell in cells)
        if len(known & set(names)) >= 2:
            return separator, names, len(cells)
        if len(cells) >= 4 and all(map(_is_number, cells)):
            return separator, (), len(cells)
    return None


def _cells(line: str, separator: str) -> list[str]:
    return line.split() if separator == " " else [cell.strip() for cell in line.split(separator)]


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _table(
    text: str, start: int, separator: str, header: tuple[str, ...], names: tuple[str, ...], count: int
) -> TextTable:
    if count > _MOST_COLUMNS:
        raise InvalidInputError(f"expected a table of at most {_MOST_COLUMNS} columns, got {count}")
    values, left_out = [], 0
    for lines in _pieces(text, start):
        if separator == " ":
            even = [line for line in lines if len(line.split()) == count]
        else:
            even = [line for line in lines if line.count(separator) == count - 1]
        left_out += len(lines) - len(even)
        if even:
            decimal = separator != "," and any("," in line for line in even)
            points = [line.replace(",", ".") for line in even] if decimal else even
            values.append(_numbers(points, separator, count))
    if not values:
        raise InvalidInputError(f"expected lines of {count} numbers, got none")
    return TextTable(header, names, np.concatenate(values), left_out)


def _pieces(text: str, start: int) -> Iterator[list[str]]:
    """Lines from `start` on, some thousand at a time, without blank ones at either end of the text."""
    last = len(text)
    while start < last and text[start] in "\r\n":
        start += 1
    while last > start and text[last - 1] in "\r\n":
        last -= 1
    while start <= last:
        end = text.find("\n", min(start + _PIECE, last), last)
        piece = text[start : end if end >= 0 else last]
        yield piece.replace("\r", "").split("\n")
        start = end + 1 if end >= 0 else last + 1


def _numbers(lines: list[str], separator: str, count: int) -> FloatArray:
    """Numbers of lines of `count` cells each, shape (lines, count), NaN where a cell is no number.

    `numpy.loadtxt` refuses blank cells, which are then filled in, and words; if there are words, all cells
    are read one by one, which takes seven times as long.
    """
    delimiter = None if separator == " " else separator
    with suppress(ValueError):
        return np.loadtxt(lines, delimiter=delimiter, comments=None, ndmin=2)
    with suppress(ValueError):
        filled = _blanks_named("\n".join(lines), separator).split("\n")
        return np.loadtxt(filled, delimiter=delimiter, comments=None, ndmin=2)
    rows = [[number(cell) for cell in _cells(line, separator)] for line in lines]
    return np.array(rows, dtype=float).reshape(-1, count)


def _blanks_named(body: str, separator: str) -> str:
    """Write ``nan`` into blank cells."""
    while separator * 2 in body:
        body = body.replace(separator * 2, f"{separator}nan{separator}")
    body = f"\n{body}\n".replace(f"\n{separator}", f"\nnan{separator}")
    return body.replace(f"{separator}\n", f"{separator}nan\n")[1:-1]


def number(cell: str) -> float:
    """The number in a cell; NaN if it is none."""
    try:
        return float(cell)
    except ValueError:
        return float("nan")
