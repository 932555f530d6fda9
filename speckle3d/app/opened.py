"""Which pages a file has."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from speckle3d.app.folder import Folder
from speckle3d.app.page import Page
from speckle3d.core.errors import InvalidInputError
from speckle3d.io.load import load_sweep


def pages_of(path: Path) -> Sequence[Page]:
    """Pages for what a file holds.

    Raises
    ------
    InvalidInputError
        If the app has no page for it.
    """
    from speckle3d.app.sweep.page import SweepPage

    folder = Folder(path)
    sweep = load_sweep(path)
    if not len(sweep):
        raise InvalidInputError(f"{path}: expected frames to look at, got none")
    return [SweepPage(sweep, folder)]
