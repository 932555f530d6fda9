"""Images nearest to points of the world, one on either side: what reslices and backward volumes blend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.threads import in_parallel
from speckle3d.imaging.axes import line_along
from speckle3d.imaging.images import PosedImages

BATCH = 16
"""Images read at a time: enough for milliseconds of work per thread, few enough for memory."""

BYTES_PER_POINT = 16
"""Distance and level of an image on either side."""

_CACHED_BYTES = 2**20
"""Points that all images of a batch are tried on before the next points: they stay in a core's cache."""

_GRAIN = 32
"""Lines below which a slice is not worth another thread's while."""


class Sides(NamedTuple):
    """Of points along lines, the nearest images behind and in front.

    Attributes
    ----------
    distance_mm : float32, shape (2, n, points)
        At right angles to the image; behind is first.
    grey : float32, shape (2, n, points)
        What the image shows there; NaN where there is none.
    """

    distance_mm: Float32Array
    grey: Float32Array

    def blended(self, alone_mm: float = np.inf) -> tuple[Float32Array, ByteArray]:
        """Interpolate between the two images by their distances.

        Parameters
        ----------
        alone_mm : float
            A point with an image on one side only takes its level if that is no farther away.

        Returns
        -------
        levels : ndarray of float32, shape (n, points)
            NaN where there are none.
        state : ndarray of uint8, shape (n, points)
            `EMPTY`; `MEASURED` where an image is no farther away than `alone_mm`; elsewhere `FILLED`.
        """
        from speckle3d.kernels.cuts import blend_nearest

        levels = np.empty(self.grey.shape[1:], np.float32)
        state = np.empty(levels.shape, np.uint8)

        def blend(first: int, stop: int) -> None:
            band = slice(first, stop)
            distance_mm, grey = self.distance_mm[:, band], self.grey[:, band]
            blend_nearest(distance_mm, grey, alone_mm, levels[band], state[band])

        in_parallel(blend, len(levels), _GRAIN)
        return levels, state


class NearestImages:
    """Images to look points of the world up in.

    Parameters
    ----------
    source : PosedImages
    max_distance_mm : float
        Images this far from a point or farther do not count.
    region : ndarray of bool, shape (vector, sample), optional
        Samples that count; by default all.

    Raises
    ------
    InvalidInputError
        If the distance is not positive and finite, or the region is not one of the images.
    """

    def __init__(self, source: PosedImages, max_distance_mm: float, region: BoolArray | None = None) -> None:
        if not (np.isfinite(max_distance_mm) and max_distance_mm > 0):
            raise InvalidInputError(f"max_distance_mm: expected a value above zero, got {max_distance_mm}")
        expected = (source.grid.vectors, source.grid.samples)
        if region is not None and region.shape != expected:
            raise InvalidInputError(f"region: expected shape {expected}, as the images, got {region.shape}")
        self._source, self.max_distance_mm = source, max_distance_mm
        self._outside = None if region is None else ~region
        image_from_world = source.world_from_image.inv().as_matrix()
        self.normals = image_from_world[:, 2, :3]
        """Where each image faces in the world, shape (n, 3)."""
        self.index_from_world = source.index_from_image() @ image_from_world
        """To (vector, sample, signed distance in mm) of each image, shape (n, 3, 4)."""
        # "Behind" and "in front" must mean the same for all images, or neighbours of opposite facing
        # (a probe turned round between two passes) would compete for one side and leave the other empty.
        self.index_from_world[self.normals @ line_along(self.normals) < 0, 2] *= -1.0

    def beside(self, lines: FloatArray, points: int, hull_mm: FloatArray) -> Sides:
        """Look up points along straight lines; as `LookUp` and `in_one_pass`."""
        return in_one_pass([LookUp(self, lines, points, hull_mm)])[0]

    def read(self, index: int) -> Float32Array:
        """One image in memory of its own, since readers may reuse theirs; NaN outside the region."""
        image = np.array(self._source.read_as_stored(index), dtype=np.float32, order="C")
        if self._outside is not None:
            image[self._outside] = np.nan
        return image

    def reach(self, hull_mm: FloatArray) -> BoolArray:
        """Whether each image's slab can reach a point: no face of it has all of their hull beyond it."""
        maps, grid = self.index_from_world, self._source.grid
        u, v, q = np.moveaxis(maps[:, :, :3] @ hull_mm.T + maps[:, :, 3:], 1, 0)
        reach = (
            (u, 0.0, grid.vectors - 1.0),
            (v, 0.0, grid.samples - 1.0),
            (q, -self.max_distance_mm, self.max_distance_mm),
        )
        near = [(c.max(axis=1) > low - 1e-3) & (c.min(axis=1) < high + 1e-3) for c, low, high in reach]
        return np.asarray(near[0] & near[1] & near[2])


class LookUp:
    """Points along straight lines, and the images nearest to them so far.

    Parameters
    ----------
    images : NearestImages
    lines : ndarray, shape (n, 2, 3)
        Of each line the first point and the step to the next one, mm in the world.
    points : int
        On each line.
    hull_mm : ndarray, shape (m, 3)
        Points in whose convex hull all others lie.
    """

    def __init__(self, images: NearestImages, lines: FloatArray, points: int, hull_mm: FloatArray) -> None:
        self.images, self._lines = images, lines
        self.near = images.reach(hull_mm)
        distance_mm = np.full((2, len(lines), points), images.max_distance_mm, dtype=np.float32)
        self.sides = Sides(distance_mm, np.full(distance_mm.shape, np.nan, dtype=np.float32))
        self._few = max(1, _CACHED_BYTES // (BYTES_PER_POINT * points))

    def add(self, batch: Mapping[int, Float32Array]) -> None:
        """Look at some of the images."""
        from speckle3d.kernels.cuts import keep_nearest

        reach_mm, (distance_mm, grey) = self.images.max_distance_mm, self.sides
        seen = [(image, self.images.index_from_world[i].copy()) for i, image in batch.items() if self.near[i]]

        def look_up(first: int, stop: int) -> None:
            for low in range(first, stop, self._few):
                band = slice(low, min(low + self._few, stop))
                for image, index_from_world in seen:
                    kept = distance_mm[:, band], grey[:, band]
                    keep_nearest(image, index_from_world, self._lines[band], reach_mm, *kept)

        in_parallel(look_up, len(self._lines), _GRAIN)


def in_one_pass(wanted: Sequence[LookUp]) -> list[Sides]:
    """Look up points of several kinds in the same images, each at poses of its own.

    One pass over the images, in any order, with memory for the points and `BATCH` images; images that reach
    no point are not even read.
    """
    asked = np.flatnonzero(np.any([each.near for each in wanted], axis=0))
    for start in range(0, len(asked), BATCH):
        batch = {int(index): wanted[0].images.read(int(index)) for index in asked[start : start + BATCH]}
        for each in wanted:
            each.add(batch)
    return [each.sides for each in wanted]
