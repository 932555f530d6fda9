"""Points picked by hand, as comma-separated text: columns x_mm, y_mm and z_mm, in the order of measuring."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.io.text import numbers, text_lines

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
    lines = ((number, text.split("#")[0]) for number, text in text_lines(path))
    rows = [(number, [cell.strip() for cell in text.split(",")]) for number, text in lines if text.strip()]
    header = rows[0][1] if rows else ["nothing"]
    if not {*columns} <= {*header}:
        raise InvalidInputError(f"{path}: expected columns {','.join(columns)}, got {','.join(header)}")
    places = []
    for number, cells in rows[1:]:
        row = dict(zip(header, cells, strict=False))
        text = " ".join(row.get(name, "") for name in columns)
        places.append(numbers(text, len(columns), f"{path}:{number}"))
    return np.array(places, dtype=float).reshape(-1, len(columns))


def parse_places(texts: Sequence[str], columns: Sequence[str] = WORLD, option: str = "--point") -> FloatArray:
    """Points given as ``X,Y,Z``, or ``X,Y``, each; shape (k, number of columns)."""
    places = [numbers(text.replace(",", " "), len(columns), option) for text in texts]
    return np.array(places, dtype=float).reshape(-1, len(columns))
