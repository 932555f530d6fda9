"""Points picked by hand, as comma-separated text: columns x_mm, y_mm and z_mm, in the order of measuring."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.files import PathLike
from speckle3d.io.text import numbers, table

WORLD = ("x_mm", "y_mm", "z_mm")
"""Columns of points of the world."""
PICTURE = ("x_mm", "y_mm")
"""Columns of points of a picture, by its axes."""


def read_places(path: PathLike, columns: Sequence[str] = WORLD) -> FloatArray:
    """Read points, shape (k, number of columns), mm; other columns, and what follows a hash, are ignored.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the line, if it is not as it must be.
    """
    rows = [" ".join(cells[name] for name in columns) for _, cells in table(path, columns)]
    return parse_places(rows, columns, str(path))


def parse_places(texts: Sequence[str], columns: Sequence[str] = WORLD, option: str = "--point") -> FloatArray:
    """Points given as ``X,Y,Z``, or ``X,Y``, each; shape (k, number of columns)."""
    places = [numbers(text.replace(",", " "), len(columns), option) for text in texts]
    return np.array(places, dtype=float).reshape(-1, len(columns))
