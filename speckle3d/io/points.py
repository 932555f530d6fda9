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
from speckle3d.io.text import numbers, text_lines

Row = tuple[int, tuple[float, float], int]
"""Frame, column and row, wire."""

_MOST_FRAMES = 2**31
"""Two years at 30 frames/s."""

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
    bare = ((number, line.partition("#")[0].strip()) for number, line in text_lines(path))
    lines = ((number, [word.strip() for word in text.split(",")]) for number, text in bare if text)
    number, heading = next(lines, (1, []))
    columns, known = [word.lower() for word in heading], (*_COLUMNS, _WIRE)
    if not set(_COLUMNS) <= set(columns) <= set(known) or len(set(columns)) < len(columns):
        raise InvalidInputError(
            f"{path}: line {number}: expected the heading {','.join(_COLUMNS)}[,{_WIRE}], got "
            f"{','.join(heading)[:60]!r}"
        )
    rows: list[Row] = []
    lines_seen: dict[tuple[int, int], int] = {}
    for number, words in lines:
        where = f"{path}: line {number}"
        if len(words) != len(columns):
            raise InvalidInputError(f"{where}: expected {len(columns)} values, got {len(words)}")
        cell = dict(zip(columns, words, strict=True))
        frame, column, row = (numbers(cell[name], 1, f"{where}: {name}")[0] for name in _COLUMNS)
        if not 0 <= frame < _MOST_FRAMES or frame != int(frame):
            raise InvalidInputError(f"{where}: frame: expected a whole number from 0, got {cell['frame']}")
        wire = _wire(cell[_WIRE], wire_names, f"{where}: wire") if _WIRE in cell else 0
        rows.append((int(frame), (column, row), wire))
        seen = lines_seen.setdefault((int(frame), wire), number)
        if seen != number and _WIRE in columns:
            got = f"wire {wire} of frame {frame:g} as on line {seen}"
            raise InvalidInputError(f"{where}: expected a wire once in a frame, got {got}")
    if not rows:
        raise InvalidInputError(f"{path}: expected points below the heading, got none")
    frames, pixels, wires = (np.array(column) for column in zip(*rows, strict=True))
    return PickedPoints(frames, pixels, wires if _WIRE in columns else None)


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
    lines = [",".join(_COLUMNS if points.wire is None else (*_COLUMNS, _WIRE))]
    for i, (frame, (column, row)) in enumerate(zip(points.frame, points.pixels, strict=True)):
        words = [f"{frame}", f"{column:.3f}", f"{row:.3f}"]
        if points.wire is not None:
            wire = int(points.wire[i])
            if wire_names and wire >= len(wire_names):
                raise InvalidInputError(f"wire: expected one of {len(wire_names)} wires, got number {wire}")
            words.append(wire_names[wire] if wire_names else str(wire))
        lines.append(",".join(words))
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
