"""Points picked in the frames of a recording: what is there, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.points import Seen
from speckle3d.io.points import PickedPoints

Point = tuple[float, float, str]
"""Column, row, and the name of the wire; empty where wires are not told apart."""

_DIGITS = 3
"""Decimal places of a column and row in a file of points."""


class Picks:
    """Points by frame; of each wire one in a frame, the last that was put there.

    Parameters
    ----------
    names : sequence of str
        Of the phantom's wires; none where they are not told apart, and a frame has one point.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self._frames: dict[int, list[Point]] = {}

    def __len__(self) -> int:
        return sum(map(len, self._frames.values()))

    @property
    def frames(self) -> tuple[int, ...]:
        """Frames that have points, ascending."""
        return tuple(sorted(self._frames))

    def of(self, frame: int) -> list[Point]:
        """Points of a frame, in the order of their wires."""
        return list(self._frames.get(frame, ()))

    def put(self, frame: int, points: Sequence[Point]) -> None:
        """Take these as the points of a frame, in place of those it had."""
        last = {
            wire if wire in self.names else "": (round(column, _DIGITS), round(row, _DIGITS))
            for column, row, wire in points
        }
        if self.names:
            last.pop("", None)
        kept = [(*place, wire) for wire, place in last.items()]
        if kept:
            self._frames[frame] = sorted(kept, key=lambda point: self._number(point[2]))
        else:
            self._frames.pop(frame, None)

    def take(self, frames: Sequence[int], pixels: Sequence[Sequence[float]], wires: Sequence[int]) -> None:
        """Take points of many frames, in place of all that were there."""
        self._frames = {}
        held: dict[int, list[Point]] = {}
        for frame, (column, row), wire in zip(frames, pixels, wires, strict=True):
            name = self.names[wire] if self.names else ""
            held.setdefault(int(frame), []).append((float(column), float(row), name))
        for frame, points in held.items():
            self.put(frame, points)

    def take_seen(self, seen: Seen) -> None:
        """Take what was found in the images."""
        wires = np.zeros(len(seen), int) if seen.wire is None else seen.wire
        self.take(seen.frame.tolist(), seen.pixels.tolist(), wires.tolist())

    def missing(self, frame: int) -> tuple[str, ...]:
        """Names of the wires that have no point in a frame."""
        there = {wire for _, _, wire in self.of(frame)}
        return tuple(name for name in self.names if name not in there)

    def points(self) -> PickedPoints:
        """All points, by frame and wire, as they are written into a file."""
        rows = [(frame, point) for frame in self.frames for point in self._frames[frame]]
        frames = np.array([frame for frame, _ in rows], dtype=np.int64)
        pixels = np.array([point[:2] for _, point in rows], dtype=float).reshape(-1, 2)
        if not self.names:
            return PickedPoints(frames, pixels)
        return PickedPoints(frames, pixels, np.array([self._number(point[2]) for _, point in rows], np.int64))

    def _number(self, wire: str) -> int:
        return self.names.index(wire) if wire else 0
