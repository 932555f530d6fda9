"""New files in the folder of the opened file, the one that the app writes to."""

from __future__ import annotations

import re
from pathlib import Path

from speckle3d.core.errors import InvalidInputError

_NO_NAME = re.compile(r"^$|^[.\s]|[\s.]$|[/\\:\0-\x1f\x7f]")
"""In names that are empty or hidden, lead elsewhere, or are none on some system."""
_MOST_BYTES = 200
"""Of the 255 that file systems take, room for the name of a temporary sibling."""


def new_path(folder: Path, name: str) -> Path:
    """Path of a new file in a folder, named in a save dialogue.

    Raises
    ------
    InvalidInputError
        If the name is not that of a file in the folder itself, or is taken.
    """
    path = folder / name
    if _NO_NAME.search(name) or len(name.encode(errors="replace")) > _MOST_BYTES:
        raise InvalidInputError(f"expected a short name of a file in {folder}, got {name!r}")
    if path.is_symlink() or path.exists():
        raise InvalidInputError(f"{path}: expected a new name, got one that is taken")
    return path
