"""Text from outside, as it may be shown: names and attributes of files, and names of files themselves."""

from __future__ import annotations

import os
import unicodedata


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
