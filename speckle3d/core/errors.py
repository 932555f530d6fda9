"""Errors raised on purpose. A message is one line: what was expected, what came, and where."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from speckle3d.core.printable import printable

_LONGEST = 1200
"""Letters of a message; a path alone may have hundreds."""


class Speckle3DError(Exception):
    """Root of every error the package raises on purpose.

    Its words may quote a file: they are shown escaped, in one line, and cut if longer than a screen.
    """

    def __init__(self, *words: object) -> None:
        super().__init__(*(_quotable(word) if isinstance(word, str) else word for word in words))


class InvalidInputError(Speckle3DError, ValueError):
    """A value, array or file content is not what it must be."""


class MismatchError(InvalidInputError):
    """Two inputs are each valid but do not belong together."""


class InsufficientDataError(Speckle3DError, ValueError):
    """The data are valid but cannot determine the answer."""


class FileError(Speckle3DError, OSError):
    """A file cannot be opened, read or written."""


class NoSpaceError(FileError):
    """There is no room left to write a file: the disk is full, or a limit on files is reached."""


def _quotable(words: str) -> str:
    text = printable(words)
    if len(text) <= _LONGEST:
        return text
    return f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 4 :]}"


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Put `where` before the message of an error about data raised in the block, unless it is there."""
    try:
        yield
    except (InvalidInputError, InsufficientDataError) as error:
        if str(error).startswith(printable(where)):
            raise
        raise type(error)(f"{where}: {error}") from error
