"""A surface: triangles in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import require_rows
from speckle3d.core.text import shown


@shown
@dataclass(frozen=True)
class Surface:
    """Triangle mesh with corners counter-clockwise as seen from outside.

    Parameters
    ----------
    vertices_mm : ndarray, shape (n, 3)
        In the world.
    triangles : ndarray of int, shape (m, 3)
        Vertices of each.
    fields : mapping of str to str
        What is said of the surface beside its shape.

    Examples
    --------
    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> round(Surface(corners, faces).volume_mm3, 6)
    0.166667
    """

    vertices_mm: FloatArray
    triangles: IntArray
    fields: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_rows(self.vertices_mm, (3,), "vertices_mm")
        if not np.isin(self.triangles, range(len(self.vertices_mm))).all():
            raise InvalidInputError(f"triangles: expected vertices 0 to {len(self.vertices_mm) - 1}")

    def __len__(self) -> int:
        """Number of triangles."""
        return len(self.triangles)

    @property
    def normals_mm2(self) -> FloatArray:
        """Outward normal of each triangle, as long as its area, shape (m, 3)."""
        a, b, c = np.moveaxis(self.vertices_mm[self.triangles], 1, 0)
        return np.asarray(np.cross(b - a, c - a) / 2)

    @property
    def normals(self) -> FloatArray:
        """Outward unit normal of each triangle, shape (m, 3); zero where it has no area."""
        normals = self.normals_mm2
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))

    @property
    def area_mm2(self) -> float:
        """Area of all triangles."""
        return float(np.linalg.norm(self.normals_mm2, axis=1).sum())

    @property
    def volume_mm3(self) -> float:
        """Enclosed volume, less cavities; meaningless for an open surface."""
        middles = self.vertices_mm[self.triangles].sum(axis=1) / 3.0 - self.vertices_mm.mean(axis=0)
        return float((self.normals_mm2 * middles).sum() / 3.0)

    def open_edges(self) -> IntArray:
        """Border edges, which only one triangle has, as pairs of vertices, shape (e, 2)."""
        edges, n = np.sort(self._edges(), axis=1), len(self.vertices_mm)
        # One number per edge: sorted ten times as fast as pairs.
        number, count = np.unique(edges @ [n, 1], return_counts=True)
        return np.column_stack(np.divmod(number[count == 1], n))

    def parts(self) -> IntArray:
        """Number, from 0, of the connected part that each triangle belongs to, shape (m,)."""
        n, (first, second) = len(self.vertices_mm), self._edges().T
        graph = coo_array((np.ones_like(first), (first, second)), shape=(n, n))
        part = connected_components(graph, directed=False)[1]
        return np.unique(part[self.triangles[:, 0]], return_inverse=True)[1]

    def of_triangles(self, chosen: IntArray | BoolArray) -> Surface:
        """Subset of the triangles (indices or a mask), with their vertices only."""
        vertices, triangles = np.unique(self.triangles[chosen], return_inverse=True)
        return Surface(self.vertices_mm[vertices], triangles, self.fields)

    def _edges(self) -> IntArray:
        """Edges of all triangles, round each, shape (3 m, 2)."""
        return self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
