"""Tables of numbers in text, by whatever separator: blank cells are NaN, lines of another length left out."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.decimals import read_decimals

SEPARATORS = ("\t", ";", ",", " ")
"""In order of trust: a tab is nothing else, a comma may be a decimal point, a space may be anything."""

_LONGEST_HEADER = 64
"""Lines, not counting comments, in which the names of the columns, or the first numbers, must come."""

_COMMENT = "#"
_LONGEST_LINE = 1 << 16
_MOST_COLUMNS = 256


@dataclass(frozen=True)
class TextTable:
    """A table as found.

    Attributes
    ----------
    header : tuple of str
        Lines before the table, without the names.
    names : tuple of str
        Of the columns; empty if there are none.
    values : ndarray, shape (rows, columns)
    left_out : int
        Lines of another length than the first.
    """

    header: tuple[str, ...]
    names: tuple[str, ...]
    values: FloatArray
    left_out: int

    def column(self, name: str) -> FloatArray | None:
        """The column of that name, shape (rows,); None if there is none, or it is blank."""
        if name not in self.names:
            return None
        values = self.values[:, self.names.index(name)]
        return values if np.isfinite(values).any() else None

    def columns(self, *names: str) -> FloatArray | None:
        """Columns side by side, shape (rows, len(names)); None if any is not there."""
        found = [self.column(name) for name in names]
        there = [column for column in found if column is not None]
        return np.stack(there, axis=1) if len(there) == len(found) else None


def read_table(text: str, known: frozenset[str]) -> TextTable:
    """Find the table in `text` and read it.

    Parameters
    ----------
    text : str
    known : frozenset of str
        Names of columns, in lower case, of which a line of names holds two at least.

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
            return _table(text[end if names else start :], separator, tuple(header), names, count)
        header.append(line)
        seen += not line.startswith(_COMMENT)
        if seen > _LONGEST_HEADER:
            break
    raise InvalidInputError("expected a table of numbers, got none")


def _lines(text: str) -> Iterator[tuple[str, int, int]]:
    """Lines, where each begins, and where the next does."""
    at = 0
    while at < len(text):
        end = text.find("\n", at)
        after = end + 1 if end >= 0 else len(text)
        yield text[at:after].strip("\r\n"), at, after
        at = after


def _begins_table(line: str, known: frozenset[str]) -> tuple[str, tuple[str, ...], int] | None:
    """Separator, names and number of the columns, if `line` has their names or the first numbers."""
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
    body: str, separator: str, header: tuple[str, ...], names: tuple[str, ...], count: int
) -> TextTable:
    if count > _MOST_COLUMNS:
        raise InvalidInputError(f"expected a table of at most {_MOST_COLUMNS} columns, got {count}")
    body = body.replace("\r", "").strip("\n")
    if separator != "," and "," in body:
        body = body.replace(",", ".")
    values, left_out = None, 0
    if separator != " ":
        values = read_decimals(body.encode("ascii", "replace"), separator, count)
    if values is None:
        values = _quickly(body, separator, count)
    if values is None:
        values, left_out = _line_by_line(body, separator, count)
    if not len(values):
        raise InvalidInputError(f"expected lines of {count} numbers, got none")
    return TextTable(header, names, values, left_out)


def _quickly(body: str, separator: str, count: int) -> FloatArray | None:
    """All lines at once; None if any has another length or holds what is no number."""
    if separator == " " or not _even(body, separator, count):
        return None
    body = _blanks_named(body, separator).replace(separator, " ")
    rows = body.count("\n") + 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # older NumPy only warns of what is no number
            flat = np.fromstring(body, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    return flat.reshape(rows, count) if flat.size == rows * count else None


def _even(body: str, separator: str, count: int) -> bool:
    """Whether every line has `count` cells."""
    characters = np.frombuffer(body.encode("ascii", "replace"), dtype=np.uint8)
    lines = np.flatnonzero(characters == ord("\n"))
    separators = np.concatenate(([0], np.cumsum(characters == ord(separator))))
    per_line = np.diff(separators[np.concatenate(([0], lines, [characters.size]))])
    return bool((per_line == count - 1).all())


def _blanks_named(body: str, separator: str) -> str:
    """Cells of nothing as ``nan``."""
    blank = separator * 2
    while blank in body:
        body = body.replace(blank, f"{separator}nan{separator}")
    body = body.replace(f"\n{separator}", f"\nnan{separator}").replace(f"{separator}\n", f"{separator}nan\n")
    body = f"nan{body}" if body.startswith(separator) else body
    return f"{body}nan" if body.endswith(separator) else body


def _line_by_line(body: str, separator: str, count: int) -> tuple[FloatArray, int]:
    """Lines of `count` cells, NaN for what is no number, and how many lines had another length."""
    rows: list[list[float]] = []
    left_out = 0
    for line in body.split("\n"):
        cells = _cells(line, separator)
        if len(cells) == count:
            rows.append([_number(cell) for cell in cells])
        else:
            left_out += 1
    return np.array(rows, dtype=float).reshape(-1, count), left_out


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
