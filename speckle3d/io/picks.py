"""Points of the world picked by hand, as comma-separated text with the columns x_mm, y_mm and z_mm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.io.text import text_lines

COLUMNS = ("x_mm", "y_mm", "z_mm")


def read_places(path: PathLike) -> FloatArray:
    """Read points of the world, shape (k, 3), mm; columns beside the three are ignored.

    Raises
    ------
    FileError
        If the file is missing or no text.
    InvalidInputError
        Naming the line, if it is not as it must be.
    """
    rows = [
        (number, [cell.strip() for cell in line.split("#")[0].split(",")])
        for number, line in text_lines(path)
        if line.split("#")[0].strip()
    ]
    if not rows or any(name not in rows[0][1] for name in COLUMNS):
        got = ",".join(rows[0][1]) if rows else "nothing"
        raise InvalidInputError(f"{path}: expected columns {','.join(COLUMNS)}, got {got}")
    at = [rows[0][1].index(name) for name in COLUMNS]
    found = [
        _place([cells[k] if k < len(cells) else "" for k in at], f"{path}:{number}")
        for number, cells in rows[1:]
    ]
    return np.array(found, dtype=float).reshape(-1, 3)


def parse_point(texts: Sequence[str]) -> FloatArray:
    """Points given as ``X,Y,Z`` each, shape (k, 3)."""
    return np.array([_place(text.split(","), "--point") for text in texts], dtype=float).reshape(-1, 3)


def _place(cells: Sequence[str], where: str) -> list[float]:
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != 3 or not np.isfinite(values).all():
        raise InvalidInputError(f"{where}: expected three numbers in mm, got {','.join(cells)!r}")
    return values
