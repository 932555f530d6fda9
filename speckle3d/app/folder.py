"""The one folder that the app writes to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from speckle3d.core.errors import InvalidInputError


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
        if not name.strip() or Path(name).name != name or name.startswith("."):
            raise InvalidInputError(f"expected the name of a file in {self.path}, got {name!r}")
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
