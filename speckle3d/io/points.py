"""Points in images picked by hand, or found and to be corrected by hand, as comma-separated text.

::

    # anything after a hash is a comment
    frame,column_px,row_px,wire
    0,605.7,191.9,G1
    0,436.2,181.1,L1

Frames count from 0, as in the sweep; columns and rows are those of its images, fractional and from 0 at the
centre of the first; images made from RF have fewer rows than it has samples. The column ``wire`` may be
missing. A wire goes by its name or by its number in the phantom, from 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.io.hdf5 import PathLike, atomic_path
from speckle3d.io.text import numbers, table

_COLUMNS = ("frame", "column_px", "row_px")
_WIRE = "wire"


@dataclass(frozen=True)
class PickedPoints:
    """Points in the frames of a sweep.

    Attributes
    ----------
    frame : ndarray of int, shape (n,)
        From 0.
    pixels : ndarray, shape (n, 2)
        Column and row, fractional.
    wire : ndarray of int, shape (n,), optional
        Number of the wire in the phantom, from 0.
    """

    frame: IntArray
    pixels: FloatArray
    wire: IntArray | None = None

    def require_inside(self, shape: tuple[int, ...]) -> None:
        """Raise `MismatchError` unless all points lie in the frames of images of `shape` (n, column, row)."""
        places = np.column_stack([self.frame, self.pixels])
        outside = ((places < [0, -0.5, -0.5]) | (places > np.array(shape) - [1, 0.5, 0.5])).any(axis=1)
        for frame, column, row in places[outside]:
            raise MismatchError(
                f"expected points within shape (frame, column, row) {shape}, got column {column:g}, "
                f"row {row:g} in frame {frame:g}"
            )


def read_points(path: PathLike, wire_names: Sequence[str] = ()) -> PickedPoints:
    """Read points, in any order of columns.

    Parameters
    ----------
    wire_names : sequence of str, optional
        The phantom's, needed where the file has a column ``wire``.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the line.
    """
    wire_of = {str(i): i for i in range(len(wire_names))} | {name: i for i, name in enumerate(wire_names)}
    rows, wires = list[list[float]](), list[int]()
    for where, cell in table(path, _COLUMNS):
        rows.append([numbers(cell[name], 1, f"{where}: {name}")[0] for name in _COLUMNS])
        if rows[-1][0] < 0 or rows[-1][0] % 1:
            raise InvalidInputError(f"{where}: frame: expected a whole number from 0, got {cell['frame']}")
        if (word := cell.get(_WIRE)) is not None:
            if word not in wire_of:
                names = ", ".join(wire_names) or "no wire"
                raise InvalidInputError(f"{where}: wire: expected {names} or its number, got {word!r}")
            wires.append(wire_of[word])
    if not rows or len({*zip(np.array(rows)[:, 0], wires, strict=False)}) < len(wires):
        raise InvalidInputError(f"{path}: expected points below the heading, a wire once in a frame")
    places = np.array(rows)
    return PickedPoints(places[:, 0].astype(int), places[:, 1:], np.array(wires) if wires else None)


def write_points(path: PathLike, points: PickedPoints, wire_names: Sequence[str] = ()) -> None:
    """Write points in a form that `read_points` reads; the file appears whole or not at all.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    columns = [points.frame.astype(str), *np.char.mod("%.3f", points.pixels.T)]
    if points.wire is not None:
        columns.append(np.array(wire_names)[points.wire] if wire_names else points.wire.astype(str))
    rows = [(*_COLUMNS, _WIRE)[: len(columns)], *zip(*columns, strict=True)]
    with atomic_path(path) as part:
        part.write_text("".join(f"{','.join(row)}\n" for row in rows), encoding="utf-8")


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
    places = [
        numbers(text.replace(",", " "), len(columns), f"{option}: {','.join(columns)}") for text in texts
    ]
    return np.array(places, dtype=float).reshape(-1, len(columns))
