"""What a command may write over: never what it reads, and of other files only its own kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from speckle3d.core.errors import FileError, InvalidInputError

_BESIDE = (".txt", ".png", ".csv")
"""What lies beside a calibration file: its table, its pictures, and the dots it was made from."""


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


def require_free(out: Path, *inputs: Path | None) -> None:
    """Refuse a calibration's place that is no calibration's, or whose report would take an input's.

    Raises
    ------
    FileError, InvalidInputError
    """
    if out.suffix in _BESIDE:
        raise InvalidInputError(
            f"{out}: expected a calibration file, not {', '.join(_BESIDE)}, which are written beside it"
        )
    require_own_place(out, "a calibration", _is_calibration, *inputs)
    beside = {out.with_suffix(suffix).resolve() for suffix in _BESIDE}
    for path in inputs:
        if path is not None and path.resolve() in beside:
            raise InvalidInputError(f"{path}: would be overwritten by the results: give -o another name")


def _is_calibration(path: Path) -> bool:
    from speckle3d.io.calibrations import FORMAT
    from speckle3d.io.hdf5 import opened

    try:
        with opened(path, FORMAT):
            return True
    except (FileError, InvalidInputError):
        return False
