"""Reslices: any plane or curved sheet through a sweep, straight from its frames or from voxels.

Resliced from the frames, each pixel blends the two images nearest to it, one on either side, sampled
bilinearly where the pixel projects onto them: no voxels, no hole filling, and the images' own resolution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.sweep import ImageGrid
from speckle3d.core.threads import in_parallel
from speckle3d.core.volume import Volume
from speckle3d.imaging.images import ChosenImages, Images, PosedImages
from speckle3d.imaging.planes import ReslicePlane as ReslicePlane
from speckle3d.imaging.planes import image_plane

_BATCH = 16
"""Images read at a time: enough for milliseconds of work per thread, few enough for memory."""

_GRAIN = 32
"""Lines of a cut below which a slice is not worth another thread's while."""


class Cut(Protocol):
    """Pixels somewhere in the world, on straight lines of even steps: `ReslicePlane`, `CurvedSheet`."""

    along_rows: bool

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of the resliced image."""

    @property
    def hull_mm(self) -> FloatArray:
        """Points in whose convex hull all pixels lie, shape (m, 3), mm in the world."""

    def lines(self) -> FloatArray:
        """Of each line the first pixel's centre and the step to the next, shape (n, 2, 3), mm."""


class _Gathering:
    """A cut while images pass by: of each pixel the nearest images' distances and levels, either side."""

    def __init__(self, source: PosedImages, cut: Cut, max_distance_mm: float) -> None:
        self._cut, self._lines, self._reach_mm = cut, cut.lines(), max_distance_mm
        self._maps = _index_from_world(source)
        self.near = _touches(self._maps, source.grid, cut.hull_mm, max_distance_mm)
        shape = (2, len(self._lines), _points_per_line(cut))
        self._distance_mm = np.full(shape, max_distance_mm, dtype=np.float32)
        self._grey = np.full(shape, np.nan, dtype=np.float32)

    def add(self, images: Mapping[int, Float32Array]) -> None:
        """Look at some of the images."""
        from speckle3d.kernels.cuts import keep_nearest

        def fill(first: int, stop: int) -> None:
            band = slice(first, stop)
            for index, image in images.items():
                if self.near[index]:
                    kept = self._distance_mm[:, band], self._grey[:, band]
                    keep_nearest(image, self._maps[index], self._lines[band], self._reach_mm, *kept)

        in_parallel(fill, len(self._lines), _GRAIN)

    def blended(self) -> Float32Array:
        """The cut, shape (rows, columns)."""
        return _upright(self._cut, _blend(self._distance_mm, self._grey))


def reslice_frames(
    images: Images,
    grid: ImageGrid,
    world_from_image: RigidTransform,
    cut: Cut,
    max_distance_mm: float,
) -> Float32Array:
    """Cut a plane or a curved sheet through a sweep's images.

    One pass over the images, in any order, with memory for the cut and a few images; images too far from
    the cut are not even read. A pixel between two images is interpolated linearly by its distances to
    their planes; with support on one side only it takes that image's level.

    Parameters
    ----------
    images : indexable or callable
        Grey images by frame number, shape (vector, sample); see `speckle3d.imaging.images.Images`.
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    cut : ReslicePlane or CurvedSheet
    max_distance_mm : float
        Images this far from a pixel or farther do not count: about the distance between frames.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
        NaN where no image is near enough.

    Raises
    ------
    InvalidInputError
        If `max_distance_mm` is not positive, or images and poses do not fit together.

    References
    ----------
    .. [1] W. Wein et al., "Backward-warping ultrasound reconstruction for improving diagnostic value and
       registration", MICCAI, 2006.
    """
    return reslice_at(images, grid, [(world_from_image, cut)], max_distance_mm)[0]


def reslice_at(
    images: Images,
    grid: ImageGrid,
    wanted: Sequence[tuple[RigidTransform, Cut]],
    max_distance_mm: float,
) -> list[Float32Array]:
    """Make several cuts, each at poses of its own, in one pass over the images; else as `reslice_frames`."""
    if not (np.isfinite(max_distance_mm) and max_distance_mm > 0):
        raise InvalidInputError(f"max_distance_mm: expected a value above zero, got {max_distance_mm}")
    sources = [PosedImages(images, grid, poses) for poses, _ in wanted]
    cuts = [_Gathering(at, cut, max_distance_mm) for at, (_, cut) in zip(sources, wanted, strict=True)]
    asked = np.flatnonzero(np.any([each.near for each in cuts], axis=0))
    for start in range(0, len(asked), _BATCH):
        batch = {int(index): sources[0].read(int(index)) for index in asked[start : start + _BATCH]}
        for each in cuts:
            each.add(batch)
    return [each.blended() for each in cuts]


def resample_image(images: Images, frame: int, grid: ImageGrid, pixel_mm: float) -> Float32Array:
    """One image on square pixels, as a reslice through its own plane shows it.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
    """
    plane = image_plane(RigidTransform.identity(), grid, pixel_mm)
    alone = ChosenImages(images, np.array([frame]))
    return reslice_frames(alone, grid, RigidTransform.identity(1), plane, 1.0)


def reslice_volume(volume: Volume, cut: Cut, state: ByteArray | None = None) -> Float32Array:
    """Cut a plane or a curved sheet through voxels, linear between them.

    Voxels that hold nothing do not count: a pixel is the mean of its other neighbours by their weights, and
    nothing if those have less than half of all.

    Parameters
    ----------
    volume : Volume
    cut : ReslicePlane or CurvedSheet
    state : ndarray of uint8, shape (n_i, n_j, n_k), optional
        0 where a voxel holds nothing. Without it, those hold nothing that are NaN; in volumes of integers
        all count, a level of 0 as well.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
        NaN outside the volume, and where it holds nothing.

    Raises
    ------
    MismatchError
        If voxels and their states differ in shape.
    """
    from speckle3d.kernels.cuts import cut_voxels

    if state is not None and state.shape != volume.shape:
        raise MismatchError(f"state: expected shape {volume.shape}, got {state.shape}")
    order: Literal["C", "F"] = "C" if volume.voxels.flags.c_contiguous else "F"
    n_i, n_j, n_k = volume.shape
    strides = np.array([n_j * n_k, n_k, 1] if order == "C" else [1, n_i, n_i * n_j])
    flat = _flat(volume.voxels, order)
    held = np.empty(0, np.uint8) if state is None else _flat(state.astype(np.uint8, copy=False), order)
    index_from_world = np.array(np.linalg.inv(volume.world_from_index)[:3], dtype=float)
    lines, sides = cut.lines(), np.array(volume.shape)
    out = np.empty((len(lines), _points_per_line(cut)), np.float32)

    def fill(first: int, stop: int) -> None:
        band = slice(first, stop)
        cut_voxels(flat, held, strides, sides, index_from_world, lines[band], out[band])

    in_parallel(fill, len(lines), _GRAIN)
    return _upright(cut, out)


def _points_per_line(cut: Cut) -> int:
    rows, columns = cut.shape
    return columns if cut.along_rows else rows


def _upright(cut: Cut, lines: Float32Array) -> Float32Array:
    """Lines of a cut as an image, shape (rows, columns)."""
    return lines if cut.along_rows else np.ascontiguousarray(lines.T)


def _flat(values: npt.NDArray[Any], order: Literal["C", "F"]) -> npt.NDArray[Any]:
    """Values as they follow in memory, without a copy where that is the order already."""
    return np.asarray(values, order=order).ravel(order)


def _index_from_world(source: PosedImages) -> FloatArray:
    """Per image, the map from the world to (vector, sample, distance in mm): (n, 3, 4)."""
    image_from_world = source.world_from_image.inv().as_matrix()
    maps = source.index_from_image() @ image_from_world
    # "Behind" and "in front" must mean the same for all images, or neighbours of opposite facing
    # (a probe turned round between two passes) would compete for one side and leave the other empty.
    normal = image_from_world[:, 2, :3]
    turned = normal @ normal.sum(axis=0) < 0
    maps[turned, 2] *= -1.0
    return np.ascontiguousarray(maps)


def _touches(maps: FloatArray, grid: ImageGrid, hull_mm: FloatArray, max_distance_mm: float) -> BoolArray:
    """Whether each image's slab can reach the cut: no slab face has all of the cut's hull beyond it."""
    u, v, q = np.moveaxis(maps[:, :, :3] @ hull_mm.T + maps[:, :, 3:], 1, 0)
    reach = (
        (u, 0.0, grid.vectors - 1.0),
        (v, 0.0, grid.samples - 1.0),
        (q, -max_distance_mm, max_distance_mm),
    )
    near = [(c.max(axis=1) > low - 1e-3) & (c.min(axis=1) < high + 1e-3) for c, low, high in reach]
    return np.asarray(near[0] & near[1] & near[2])


def _blend(distance_mm: Float32Array, grey: Float32Array) -> Float32Array:
    """Interpolate between the nearest images of either side, or take the only one there is."""
    gap = distance_mm.sum(axis=0)
    share = np.divide(distance_mm[0], gap, out=np.zeros_like(gap), where=gap > 0)
    between = grey[0] + share * (grey[1] - grey[0])
    alone = np.where(np.isnan(grey[0]), grey[1], grey[0])
    return np.asarray(np.where(np.isnan(between), alone, between), dtype=np.float32)
