"""Text files of numbers, read line by line so that an error names the file and the line."""

import io
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.io.hdf5 import reading


def text_lines(path: PathLike) -> Iterator[tuple[int, str]]:
    """Yield number, from 1, and text of every line of a file that holds more than blanks.

    Raises
    ------
    FileError
        If the file cannot be read, or its bytes are not UTF-8, or UTF-16 behind a byte order mark, as of
        Windows' PowerShell.
    """
    with reading(path), open_regular(path) as stream:
        encoding = "utf-16" if stream.peek()[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8-sig"
        with io.TextIOWrapper(stream, encoding) as lines:
            for number, line in enumerate(lines, start=1):
                if text := line.strip():
                    yield number, text


def parse_number(word: str) -> float:
    """Number that a word is, whose comma is a decimal one; NaN where it is none."""
    try:
        return float(word.replace(",", "."))
    except ValueError:
        return np.nan


def numbers(text: str, count: int | None, where: str) -> tuple[float, ...]:
    """Read finite numbers separated by blanks, `count` of them unless it is None."""
    values = tuple(map(parse_number, text.split()))
    if not values or (count is not None and len(values) != count) or not np.isfinite(values).all():
        raise InvalidInputError(f"{where}: expected {count or 'some'} finite number(s), got {text!r:.40}")
    return values


def number_text(values: npt.ArrayLike, between: str = " ") -> str:
    """Numbers as text that is read back exactly, without negative zeros."""
    plain = (np.ravel(values).astype(float) + 0.0).tolist()
    return between.join(repr(value).removesuffix(".0") for value in plain)


def table(path: PathLike, columns: Sequence[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the place and the cells of every row of comma-separated text, by the names in its first line.

    What follows a hash is a comment; columns may be more than those asked for, in any order.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If a column is missing, or a row has more or fewer cells than the heading.
    """
    lines = ((number, line.partition("#")[0].strip()) for number, line in text_lines(path))
    rows = ((number, [cell.strip() for cell in text.split(",")]) for number, text in lines if text)
    heading = [cell.lower() for cell in next(rows, (0, ["nothing"]))[1]]
    if not {*columns} <= {*heading}:
        raise InvalidInputError(f"{path}: expected columns {','.join(columns)}, got {','.join(heading)}")
    for number, cells in rows:
        where = f"{path}: line {number}"
        if len(cells) != len(heading):
            raise InvalidInputError(f"{where}: expected {len(heading)} values, got {len(cells)}")
        yield where, dict(zip(heading, cells, strict=True))


def unescape(text: str) -> str:
    r"""Text with the line breaks and backslashes that NRRD's fields have as ``\n`` and ``\\``."""
    return re.sub(r"\\([n\\])", lambda match: "\n" if match[1] == "n" else "\\", text)
