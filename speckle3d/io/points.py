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

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.geometry import require_finite
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

    def __post_init__(self) -> None:
        n = len(self.frame)
        if self.pixels.shape != (n, 2) or (self.wire is not None and self.wire.shape != (n,)):
            raise MismatchError(f"points: expected {n} of each, got pixels of shape {self.pixels.shape}")
        require_finite(self.pixels, "pixels")
        if n and (self.frame.min() < 0 or (self.wire is not None and self.wire.min() < 0)):
            raise InvalidInputError("points: expected frames and wires from 0, got a negative number")

    def __len__(self) -> int:
        return len(self.frame)

    def require_inside(self, shape: tuple[int, ...]) -> None:
        """Raise `MismatchError` unless all points lie in the frames of images of `shape` (n, column, row)."""
        count, *size = shape
        if len(self) and int(self.frame.max()) >= count:
            raise MismatchError(f"expected frames from 0 to {count - 1}, got frame {int(self.frame.max())}")
        outside = ((self.pixels < -0.5) | (self.pixels > np.array(size) - 0.5)).any(axis=1)
        if outside.any():
            first = int(np.argmax(outside))
            column, row = self.pixels[first]
            raise MismatchError(
                f"expected points within images of {size[0]} columns and {size[1]} rows, got column "
                f"{column:g}, row {row:g} in frame {int(self.frame[first])}"
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
    frames, pixels, wires = list[int](), list[tuple[float, float]](), list[int]()
    for where, cell in table(path, _COLUMNS):
        frame, column, row = (numbers(cell[name], 1, f"{where}: {name}")[0] for name in _COLUMNS)
        if frame < 0 or frame != int(frame):
            raise InvalidInputError(f"{where}: frame: expected a whole number from 0, got {cell['frame']}")
        frames.append(int(frame))
        pixels.append((column, row))
        if _WIRE in cell:
            wires.append(_wire(cell[_WIRE], wire_names, f"{where}: wire"))
            if (frames[-1], wires[-1]) in [*zip(frames, wires, strict=True)][:-1]:
                raise InvalidInputError(f"{where}: expected a wire once in a frame, got {cell[_WIRE]} again")
    if not frames:
        raise InvalidInputError(f"{path}: expected points below the heading, got none")
    return PickedPoints(np.array(frames), np.array(pixels), np.array(wires) if wires else None)


def write_points(path: PathLike, points: PickedPoints, wire_names: Sequence[str] = ()) -> None:
    """Write points in a form that `read_points` reads; the file appears whole or not at all.

    Raises
    ------
    FileError
        If the file cannot be written.
    InvalidInputError
        If a name cannot be written, or a wire has none although names are given.
    """
    for name in wire_names:
        if name != name.strip() or not name or set(name) & set(",#\r\n"):
            raise InvalidInputError(f"wire: expected a name without comma, hash or line break, got {name!r}")
    named = _COLUMNS if points.wire is None else (*_COLUMNS, _WIRE)
    if points.wire is not None and wire_names and points.wire.max(initial=0) >= len(wire_names):
        raise InvalidInputError(
            f"wire: expected one of {len(wire_names)} wires, got number {points.wire.max()}"
        )
    lines = [",".join(named)]
    for i, (frame, (column, row)) in enumerate(zip(points.frame, points.pixels, strict=True)):
        line = f"{frame},{column:.3f},{row:.3f}"
        if points.wire is not None:
            line += f",{wire_names[points.wire[i]] if wire_names else points.wire[i]}"
        lines.append(line)
    with atomic_path(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _wire(word: str, names: Sequence[str], where: str) -> int:
    numbered = {str(number): number for number in range(len(names))}
    wire = (numbered | {name: number for number, name in enumerate(names)}).get(word)
    if wire is None:
        known = (
            f"one of {', '.join(names)} or its number from 0" if names else "no wire, the phantom having none"
        )
        raise InvalidInputError(f"{where}: expected {known}, got {word!r}")
    return wire
