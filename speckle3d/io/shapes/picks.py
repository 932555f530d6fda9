"""Points picked by hand, as comma-separated text: columns x_mm, y_mm and z_mm, in the order of measuring."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.io.text import text_lines

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
    rows = [
        (number, [cell.strip() for cell in text.split("#")[0].split(",")])
        for number, text in text_lines(path)
        if text.split("#")[0].strip()
    ]
    if not rows or any(name not in rows[0][1] for name in columns):
        got = ",".join(rows[0][1]) if rows else "nothing"
        raise InvalidInputError(f"{path}: expected columns {','.join(columns)}, got {got}")
    at = [rows[0][1].index(name) for name in columns]
    found = [
        _place([cells[k] if k < len(cells) else "" for k in at], f"{path}:{number}")
        for number, cells in rows[1:]
    ]
    return np.array(found, dtype=float).reshape(-1, len(columns))


def parse_places(texts: Sequence[str], columns: Sequence[str] = WORLD, option: str = "--point") -> FloatArray:
    """Points given as ``X,Y,Z``, or ``X,Y``, each; shape (k, number of columns)."""
    found = [_place(text.split(","), option, len(columns)) for text in texts]
    return np.array(found, dtype=float).reshape(-1, len(columns))


def _place(cells: Sequence[str], where: str, count: int | None = None) -> list[float]:
    wanted = len(cells) if count is None else count
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != wanted or not np.isfinite(values).all():
        raise InvalidInputError(f"{where}: expected {wanted} numbers in mm, got {','.join(cells)!r}")
    return values
