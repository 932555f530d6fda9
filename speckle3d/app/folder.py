"""The one folder that the app writes to."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from speckle3d.core.errors import InvalidInputError

_NO_NAME = re.compile(r"^[.\s]|[\s.]$|[/\\:\0-\x1f\x7f]")
"""In names that are hidden, lead elsewhere or are none on some system."""

_LONGEST = 200
"""Of the 255 bytes that file systems take, room for the name of a temporary sibling."""


class Folder:
    """The folder of the opened file: what a save dialogue names is written there and nowhere else.

    Parameters
    ----------
    opened : path
        The opened file.
    """

    def __init__(self, opened: Path) -> None:
        self.opened = opened.resolve()
        self.path = self.opened.parent

    def place(self, name: str) -> Path:
        """Path of a new file in the folder.

        Raises
        ------
        InvalidInputError
            If the name is not that of a file in the folder itself, or is taken.
        """
        inside = self.path / name
        if not name.strip() or _NO_NAME.search(name) or Path(name).name != name:
            raise InvalidInputError(f"expected the name of a file in {self.path}, got {name!r}")
        if len(name.encode(errors="replace")) > _LONGEST:
            raise InvalidInputError(f"expected a name of at most {_LONGEST} bytes, got {len(name)} letters")
        if inside.is_symlink() or inside.exists():
            raise InvalidInputError(f"{inside}: expected a new name, got one that is taken")
        return inside

    def save(self, name: str, write: Callable[[Path], object]) -> Path:
        """Let `write` make a new file of that name, whole or not at all."""
        from speckle3d.io.hdf5 import atomic_path

        target = self.place(name)
        with atomic_path(target) as path:
            write(path)
        return target
