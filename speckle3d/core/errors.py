"""Errors raised on purpose, and doubts about a recording; a message is one line: expected, got, and where."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from speckle3d.core.text import printable

_LONGEST = 1200
"""Letters of a message; a path alone may have hundreds."""


class Speckle3DError(Exception):
    """Root of every error the package raises on purpose.

    Its message may quote a file: it is shown escaped, in one line, and cut if longer than a screen.
    """

    def __init__(self, message: str) -> None:
        text = printable(message)
        if len(text) > _LONGEST:
            text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 4 :]}"
        super().__init__(text)


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


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Put `where` before the message of an error about data raised in the block, unless it is there."""
    try:
        yield
    except (InvalidInputError, InsufficientDataError) as error:
        if str(error).startswith(printable(where)):
            raise
        raise type(error)(f"{where}: {error}") from error


DECISIVE = math.log(100.0)
"""Logarithm of the ratio of likelihoods that is decisive evidence (H. Jeffreys, "Theory of Probability")."""


@dataclass(frozen=True)
class Doubt:
    """A contradiction between streams of one recording, or within one.

    Attributes
    ----------
    about : str
        What is doubted: "tracker", "orientation sensor", "curves" or "images"; "images and
        tracker" where these disagree.
    suspect : str
        The likely cause in a word or two: "units", "handedness", ...; empty where either may be wrong.
    evidence : str
        What was expected and what was seen, one line with figures.
    refuted : bool
        True if no honest noise explains it: what rests on it is refused. False: used, and flagged.
    frames : tuple of (int, int)
        First and last frames of the stretches where it was found; empty for the recording as a whole.
    """

    about: str
    suspect: str
    evidence: str
    refuted: bool
    frames: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        # As read from JSON these are lists.
        object.__setattr__(self, "frames", tuple((int(first), int(last)) for first, last in self.frames))

    def __str__(self) -> str:
        cause = f" (suspect: {self.suspect})" if self.suspect else ""
        return f"{self.about}: {self.evidence}{cause}{'; refused' if self.refuted else ''}"
