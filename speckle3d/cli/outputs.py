"""What a command may write over: never what it reads, and of other files only its own kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from speckle3d.core.errors import InvalidInputError


def require_own_place(out: Path, what: str, is_own: Callable[[Path], bool], *inputs: Path | None) -> None:
    """Refuse an output that is an input, by whatever name, or a file that the command would not have written.

    Parameters
    ----------
    what : str
        What the command writes, in words.
    is_own : callable
        Whether an existing file is of that kind; one without content is always free.

    Raises
    ------
    FileError
        If the place cannot be written.
    InvalidInputError
        If it is taken.
    """
    from speckle3d.io.hdf5 import require_target

    target = require_target(out)
    if not target.exists():
        return
    if any(path is not None and path.exists() and path.samefile(target) for path in inputs):
        raise InvalidInputError(f"{out}: is an input and would be overwritten: give -o another name")
    if target.stat().st_size and not is_own(target):
        raise InvalidInputError(f"{out}: expected a new name or {what} to replace, got another kind of file")
