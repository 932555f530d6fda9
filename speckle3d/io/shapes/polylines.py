"""Lines in space as legacy VTK files of one data set, binary; the header says that axes are LPS."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike
from speckle3d.io.hdf5 import atomic_path
from speckle3d.io.shapes.surfaces import SPACE


def write_polylines(
    path: PathLike, lines_mm: FloatArray, values: Mapping[str, npt.NDArray[np.floating]] | None = None
) -> None:
    """Write lines of equally many points; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        With the suffix .vtk.
    lines_mm : ndarray, shape (n, points, 3)
        In a world whose axes lead left, posterior and superior; stored in single precision.
    values : mapping of str to ndarray, shape (n,), optional
        What each line is coloured by; names without blanks.

    Raises
    ------
    InvalidInputError
        If there is no line, or points are not finite.
    FileError
        If the file cannot be written.
    """
    if not lines_mm.size or not np.isfinite(lines_mm).all():
        raise InvalidInputError(f"{path}: expected lines of finite points, got shape {lines_mm.shape}")
    count, points = lines_mm.shape[:2]
    cells = np.insert(np.arange(count * points).reshape(count, points), 0, points, axis=1)
    pieces: list[bytes] = [
        f"# vtk DataFile Version 4.2\nspeckle3d lines. {SPACE}\nBINARY\nDATASET POLYDATA\n".encode(),
        f"POINTS {count * points} float\n".encode(),
        lines_mm.astype(">f4").tobytes(),
        f"\nLINES {count} {cells.size}\n".encode(),
        cells.astype(">i4").tobytes(),
        f"\nCELL_DATA {count}\n".encode() if values else b"",
    ]
    for name, numbers in (values or {}).items():
        pieces.append(f"SCALARS {name} float 1\nLOOKUP_TABLE default\n".encode())
        pieces.append(numbers.astype(">f4").tobytes())
    with atomic_path(path) as part:
        part.write_bytes(b"".join(pieces) + b"\n")
