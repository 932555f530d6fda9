"""What every command refuses before it begins or loads anything heavy: places, files, modes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from speckle3d.core.errors import FileError, InvalidInputError

OUTPUTS: dict[str, Sequence[str]] = {
    "reconstruct": ("out", "save_curves", "volume"),
    "live": ("out", "volume"),
    "volume": ("out", "state", "deviation"),
    "accuracy": ("figure",),
    "view": ("record",),
}
"""Parameters of commands that name what is written; of the others it is `out` alone."""

_REFERENCES = ("tracker", "truth")


def require_before_work(command: str, values: Mapping[str, Any], options: Mapping[str, str]) -> None:
    """Refuse a command's files and choices that cannot be right, in no time.

    Parameters
    ----------
    command : str
        Its own name, without its group's.
    values : mapping of str to object
        By parameter.
    options : mapping of str to str
        Parameters that are options, as they are typed.

    Raises
    ------
    FileError
        If an input is not there, or an output cannot be written where it is to be.
    InvalidInputError
        If a drift mode or a reference is none.
    """
    outputs = OUTPUTS.get(command, ("out",))
    for name, value in values.items():
        for path in value if isinstance(value, list | tuple) else (value,):
            if not isinstance(path, Path):
                continue
            if name in outputs:
                _require_writable(path)
            elif not path.exists():
                raise FileError(f"{_typed(name, options)}{path}: expected a file, got none")
    if command in _CORRECTING:
        for name, known in _CHOICES.items():
            for value in _listed(values.get(name)):
                if value not in known:
                    from speckle3d.core.reconstruction import REMOVED_MODES

                    where = _typed(name, options)
                    if value in REMOVED_MODES:
                        raise InvalidInputError(f"{where}{value} was removed: {REMOVED_MODES[value]}")
                    raise InvalidInputError(f"{where}expected one of {', '.join(known)}, got {value!r}")


def _typed(name: str, options: Mapping[str, str]) -> str:
    return f"{options[name]}: " if name in options else ""


def _listed(value: Any) -> list[Any]:
    if value is None:
        return []
    return list(value) if isinstance(value, list | tuple) else [value]


def _require_writable(path: Path) -> None:
    """Refuse a place whose folder, or the nearest above it that there is, takes no new file."""
    if not str(path).strip("\0") or "\0" in str(path):
        raise InvalidInputError("expected the name of a file to write, got one that no file can have")
    folder = path.absolute().parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise FileError(f"{path}: expected an existing folder, got the file {folder}")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise FileError(f"{path}: cannot be written: {error.strerror}") from error


_MODES = ("orientation", "pose", "crossed", "fused", "consistent-subset")
_CHOICES = {"drift": _MODES, "reference": _REFERENCES}
_CORRECTING = ("reconstruct", "compare")
