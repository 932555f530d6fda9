"""Nearest images on either side of points, blended by reslices and backward volumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.threads import in_parallel
from speckle3d.core.volume import EMPTY, FILLED, MEASURED
from speckle3d.imaging.axes import line_along
from speckle3d.imaging.images import PosedImages

_BATCH = 16
"""Images read at a time: enough for milliseconds of work per thread, few enough for memory."""

_CACHED_POINTS = 2**16
"""Points that all images of a batch are tried on before the next: 1 MB stays in a core's cache."""

_GRAIN = 32
"""Lines below which a slice is not worth another thread's while."""


class NearestImages:
    """Nearest images so far, one on either side, of points along straight lines.

    Parameters
    ----------
    source : PosedImages
    lines : ndarray, shape (n, 2, 3)
        Of each line the first point and the step to the next one, mm in the world.
    points : int
        On each line.
    hull_mm : ndarray, shape (m, 3)
        Points in whose convex hull all others lie.
    reach_mm : float
        Images this far from a point or farther do not count.

    Raises
    ------
    InvalidInputError
        If the distance is not positive and finite.
    """

    def __init__(
        self, source: PosedImages, lines: FloatArray, points: int, hull_mm: FloatArray, reach_mm: float
    ) -> None:
        if not 0 < reach_mm < np.inf:
            raise InvalidInputError(f"reach_mm: expected a value above zero, got {reach_mm}")
        self.source, self._lines, self._reach_mm = source, lines, reach_mm
        image_from_world = source.world_from_image.inv().as_matrix()
        normals = image_from_world[:, 2, :3]
        # To (vector, sample, signed distance in mm) of each image. "Behind" and "in front" must mean the same
        # for all images, or neighbours of opposite facing (a probe turned round between two passes) would
        # compete for one side and leave the other empty.
        self._index_from_world = source.index_from_image() @ image_from_world
        self._index_from_world[normals @ line_along(normals) < 0, 2] *= -1.0
        # An image reaches no point if all of the hull lies beyond one face of its slab.
        place = self._index_from_world[:, :, :3] @ hull_mm.T + self._index_from_world[:, :, 3:]
        last = np.array([source.grid.vectors - 1.0, source.grid.samples - 1.0, reach_mm])
        inside = (place.max(axis=2) > last * [0, 0, -1] - 1e-3) & (place.min(axis=2) < last + 1e-3)
        self.near = inside.all(axis=1)
        # Distance at right angles to the image, and what it shows: of images behind, then of those in front.
        self._distance_mm = np.full((2, len(lines), points), reach_mm, dtype=np.float32)
        self._grey = np.full(self._distance_mm.shape, np.nan, dtype=np.float32)

    def add(self, batch: Mapping[int, Float32Array]) -> None:
        """Update the nearest images with some more images."""
        from speckle3d.kernels.cuts import keep_nearest

        looks = [(image, self._index_from_world[i].copy()) for i, image in batch.items() if self.near[i]]
        few = max(1, _CACHED_POINTS // self._grey.shape[2])

        def look(first: int, stop: int) -> None:
            for low in range(first, stop, few):
                band = slice(low, min(low + few, stop))
                nearest = self._distance_mm[:, band], self._grey[:, band]
                for image, index_from_world in looks:
                    keep_nearest(image, index_from_world, self._lines[band], self._reach_mm, *nearest)

        in_parallel(look, len(self._lines), _GRAIN)

    def blend(self, alone_mm: float = np.inf) -> tuple[Float32Array, ByteArray]:
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
        levels = np.empty(self._grey.shape[1:], np.float32)
        state = np.empty(levels.shape, np.uint8)

        def blend_lines(first: int, stop: int) -> None:
            band = slice(first, stop)
            distance, (back, front) = self._distance_mm[:, band], self._grey[:, band]
            present = ~np.isnan(self._grey[:, band])
            near = (present & (distance <= alone_mm)).any(axis=0)
            with np.errstate(invalid="ignore"):
                between = back + distance[0] / (distance[0] + distance[1]) * (front - back)
            alone = np.where(present[0], back, front)
            state[band] = np.select([near, present.all(axis=0)], [MEASURED, FILLED], EMPTY)
            levels[band] = np.where(np.isnan(between), alone, between)
            levels[band][state[band] == EMPTY] = np.nan

        in_parallel(blend_lines, len(levels), _GRAIN)
        return levels, state


def look_up(targets: Sequence[NearestImages], region: BoolArray | None = None) -> None:
    """Look up points of several kinds in the same images, each at poses of its own.

    One pass over the images, in any order, with memory for the points and a few images; images that reach no
    point are not even read.

    Parameters
    ----------
    targets : sequence of NearestImages
        Changed.
    region : ndarray of bool, shape (vector, sample), optional
        Samples that count; by default all.

    Raises
    ------
    InvalidInputError
        If the region is not one of the images.
    """
    source = targets[0].source
    expected = (source.grid.vectors, source.grid.samples)
    if region is not None and region.shape != expected:
        raise InvalidInputError(f"region: expected shape {expected}, as the images, got {region.shape}")

    def read(index: int) -> Float32Array:
        # In memory of its own, since readers may reuse theirs.
        image = np.array(source.read(index), dtype=np.float32, order="C")
        if region is not None:
            image[~region] = np.nan
        return image

    frames = np.flatnonzero(np.any([points.near for points in targets], axis=0)).tolist()
    for start in range(0, len(frames), _BATCH):
        batch = {index: read(index) for index in frames[start : start + _BATCH]}
        for points in targets:
            points.add(batch)
