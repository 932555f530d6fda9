"""Phantoms made of stretched wires: the line of each wire, and which wires form an N."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError

_PARALLEL_SINE = 0.02
"""Sine of about one degree, within which the outer wires of an N are parallel. Holes are drilled to 0.1 mm
over tens of millimetres, a quarter of that."""


@dataclass(frozen=True)
class WirePhantom:
    """Straight wires in the phantom's own frame C.

    Parameters
    ----------
    names : tuple of str, length k
        All different.
    ends_mm : ndarray, shape (k, 2, 3)
        Between which each wire is stretched.
    patterns : tuple of tuple of int
        Wires that lie in one plane, in the order in which an image shows them from one side to the other.
        Three of which the outer two are parallel and the middle one is not are an N (`n_shapes`).
    world_from_phantom : RigidTransform, optional
        Where the phantom is in the position sensor's world, if that was measured.

    Raises
    ------
    InvalidInputError
        If there are no wires, one has no length, or names repeat.
    """

    names: tuple[str, ...]
    ends_mm: FloatArray
    patterns: tuple[tuple[int, ...], ...] = ()
    world_from_phantom: RigidTransform | None = None

    def __post_init__(self) -> None:
        if not 0 < len(set(self.names)) == len(self.names):
            raise InvalidInputError(f"wires: expected different names, got {', '.join(self.names) or 'none'}")
        for name, (begin, end) in zip(self.names, self.ends_mm, strict=True):
            if not 0 < np.linalg.norm(end - begin) < np.inf:
                raise InvalidInputError(f"wire {name}: expected two different ends, got one")

    @cached_property
    def points_mm(self) -> FloatArray:
        """The middle of each wire, shape (k, 3)."""
        return np.asarray(self.ends_mm.mean(axis=1))

    @cached_property
    def directions(self) -> FloatArray:
        """Along each wire, of unit length, shape (k, 3)."""
        along = np.diff(self.ends_mm, axis=1)[:, 0]
        return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def n_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Those of the patterns that are an N: outer, middle and outer wire."""

        def is_n(wires: tuple[int, ...]) -> bool:
            first, *others = self.directions[list(wires)]
            middle, outer = np.linalg.norm(np.cross(first, others), axis=1)
            return bool(outer < _PARALLEL_SINE < middle)

        return tuple(wires for wires in self.patterns if len(wires) == 3 and is_n(wires))

    def crossings_mm(self) -> FloatArray:
        """Where the middle wire of each N meets the first and the last wire, shape (n_shapes, 2, 3)."""

        def crossing(middle: int, outer: int) -> FloatArray:
            along, beside = self.directions[[middle, outer]]
            between = self.points_mm[outer] - self.points_mm[middle]
            step, _ = np.linalg.lstsq(np.stack([along, -beside], axis=1), between)[0]
            return np.asarray(self.points_mm[middle] + step * along)

        ends = [crossing(n[1], outer) for n in self.n_shapes for outer in (n[0], n[2])]
        return np.reshape(ends, (-1, 2, 3))

    def equations(self, wire: IntArray) -> tuple[FloatArray, FloatArray]:
        """Equations of positions in C on the wires with these numbers, shape (...).

        Returns
        -------
        rows : ndarray, shape (..., 2, 3)
        offsets : ndarray, shape (..., 2)
            ``rows @ position - offsets`` are the two components, mm, of a position's distance from its wire.
        """
        # Two unit vectors square to each wire and to each other.
        rows = np.linalg.svd(self.directions[:, None])[2][wire, 1:]
        return rows, np.asarray((rows @ self.points_mm[wire][..., None])[..., 0])
