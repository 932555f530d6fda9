"""Text for people: what comes from outside escaped, rows aligned, results shown in a few lines."""

import os
import textwrap
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import fields
from itertools import count
from math import prod
from typing import Any, TypeVar

Record = TypeVar("Record", bound=type)


def printable(text: str, kept: str = "") -> str:
    r"""Escape every character that is no letter, mark, number, sign or blank, as Python writes it.

    Control characters could drive a terminal, line breaks forge a line, overrides of the writing direction
    show a name backwards, and half a surrogate pair (a file name that is no Unicode) cannot be written.
    Escaped text stays as it is when escaped again.

    Parameters
    ----------
    kept : str
        Characters to leave as they are, for instance a line break.

    Examples
    --------
    >>> printable("a\x1b[31m\nb"), printable("Größe 3 µm"), printable("a\nb", kept="\n")
    ('a\\x1b[31m\\nb', 'Größe 3 µm', 'a\nb')
    """
    return "".join(
        c
        if c.isprintable() or unicodedata.category(c) == "Zs" or c in kept
        else c.encode("unicode_escape").decode("ascii")
        for c in text
    )


def written_path(path: str | os.PathLike[str]) -> str:
    """Path as text that every file can hold: bytes of a name that are no Unicode are escaped."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def text_table(lines: Sequence[Sequence[str]], left: Collection[int] = (0,), heading: bool = True) -> str:
    """Align columns of text by the width of their characters in a terminal.

    Parameters
    ----------
    lines : sequence of sequence of str
        Cells, shown escaped (`printable`); the first line is the heading, if there is one.
    left : collection of int
        Columns aligned to the left; the others to the right.
    heading : bool
        Rule off the first line.

    Returns
    -------
    str
        Lines without trailing blanks, each ending in a newline.
    """
    from rich.cells import cell_len

    body = [[printable(cell) for cell in line] for line in lines]
    widths = [max(map(cell_len, column)) for column in zip(*body, strict=True)]
    if heading:
        body.insert(1, ["-" * width for width in widths])

    def padded(column: int, cell: str) -> str:
        blanks = " " * (widths[column] - cell_len(cell))
        return cell + blanks if column in left else blanks + cell

    return "".join("  ".join(map(padded, count(), line)).rstrip() + "\n" for line in body)


def text_rows(rows: Sequence[tuple[str, str, str]]) -> str:
    """Align rows of description, value and unit, as commands print them."""
    return text_table([(name, f"{value} {unit}".rstrip()) for name, value, unit in rows], (0, 1), False)


def shown(cls: Record) -> Record:
    """Make a dataclass show its fields, one in a line; arrays and poses are told by type and shape."""
    cls.__repr__ = _text  # type: ignore[assignment]
    return cls


def _text(self: Any) -> str:
    rows = {field.name: getattr(self, field.name) for field in fields(self) if field.repr}
    width = max(map(len, rows))
    lines = (f"  {name:<{width}}  {_brief(value)}" for name, value in rows.items())
    return "\n".join([type(self).__name__, *lines])


def _brief(value: Any) -> str:
    """One short line for a value."""
    if hasattr(value, "dtype") and prod(value.shape) > 6:
        text = f"{value.dtype} {value.shape}"
    elif hasattr(value, "single"):
        text = type(value).__name__ + ("" if value.single else f" ({len(value)},)")
    elif isinstance(value, dict | tuple):
        text = ", ".join(map(_brief, value)) if len(value) <= 4 else f"{len(value)}"
    else:
        text = f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)
    return textwrap.shorten(text or "none", 72, placeholder="…")
