"""The one folder that the app writes to."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from speckle3d.core.errors import InvalidInputError

_NO_NAME = re.compile(r"^$|^[.\s]|[\s.]$|[/\\:\0-\x1f\x7f]|.{100}")
"""In names that are empty or hidden, lead elsewhere, or are none on some system; of 100 characters none is
longer than the bytes that file systems take, with room for the name of a temporary sibling."""


class Folder:
    """The folder of the opened file: what a save dialogue names is written there and nowhere else.

    Parameters
    ----------
    file : path
        The opened file.
    """

    def __init__(self, file: Path) -> None:
        self.file = file.resolve()
        self.path = self.file.parent

    def place(self, name: str) -> Path:
        """Path of a new file in the folder.

        Raises
        ------
        InvalidInputError
            If the name is not that of a file in the folder itself, or is taken.
        """
        inside = self.path / name
        if _NO_NAME.search(name):
            raise InvalidInputError(f"expected a short name of a file in {self.path}, got {name!r}")
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
