"""Splatting of images into voxels, with rules for several samples in one voxel.

The rule "plus" keeps means in whole grey levels, as PLUS and 3D Slicer do, for comparing volumes with theirs
voxel by voxel. Both stand on IGSIO, whose ``vtkIGSIOPasteSliceIntoVolume`` differs from the mean of the
samples, with ``Optimization="FULL"`` (the default), in this:

- Places, and the steps from a pixel to the next, are whole multiples of 2^-14 voxel: over a row of 820
  pixels a place is off by up to 0.025 voxel.
- Rows are taken from the top and columns from the left, and the mean is a whole grey level after each pixel:
  cut with "nearest", so that it falls, and rounded with "linear", so that late pixels do not move it.
- Weights are kept in 16 bits, in steps of 1/256 pixel: from the 256th pixel on, each counts for 1/256.
- Pixels come in the order of one thread; with more, PLUS's own volumes may differ between runs.
- With "linear", a pixel that has a share in a voxel beyond the grid counts nowhere.

Holes are filled as for the other rules, not along PLUS's sticks: compare without filling. On PLUS's own grid
and at its own matrices volumes are equal to the last level. Poses are rigid here, and headers have six digits
of the origin; by that much, 0.0005 mm, some pixels fall into another voxel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.images import any_thread
from speckle3d.core.threads import cores, in_parallel
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.settings import Rule, Splat
from speckle3d.kernels.samples import PLUS_BITS, POSITION_BITS, SHARE_BITS, Samples

_DIRECT = ("uint8", "int16", "uint16", "float32")
"""Types that kernels read as they are; others become float32."""
_BORDER = 2.0**-24
"""Voxels. A sample less than this below a border lies on it, and belongs to the voxel above."""
_FARTHEST = 2.0**22
"""Voxels from the grid's first, so that positions fit in 64 bits."""
_BATCH_BYTES, _BATCH_FRAMES = 2**25, 32
"""Frames worked on together: enough that threads are not started for each."""
_LEAST_BLOCK = 16
"""Voxels: below, cutting lines to blocks takes longer than another thread saves."""


def splat_images(
    source: PosedImages,
    voxel_grid: VoxelGrid,
    splat: Splat,
    rule: Rule,
    weights: FloatArray | None = None,
    mask: BoolArray | None = None,
) -> tuple[Float32Array, ByteArray]:
    """Splat images into the voxels of a grid.

    Parameters
    ----------
    source : PosedImages
    voxel_grid : VoxelGrid
    splat, rule
        As `CompoundingSettings` has them.
    weights : ndarray, shape (n,), optional
        Of the frames, for the rule "weighted".
    mask : ndarray of bool, shape (vector, sample), optional
        Samples that count.

    Returns
    -------
    voxels : ndarray of float32, shape (n_k, n_j, n_i)
        NaN where no sample was.
    state : ndarray of uint8
        1 where one was, else 0.

    Raises
    ------
    MismatchError
        If images differ in type.
    InvalidInputError
        If a pose is not finite, there is not one weight per frame, the mask is not of the images' shape, no
        sample counts, an image reaches too far beyond the grid, or with "plus" levels are not of 0 to 255.
    """
    side, n = (source.grid.vectors, source.grid.samples), len(source)
    mask = np.ones(side, dtype=bool) if mask is None else mask
    if mask.shape != side or not mask.any():
        raise InvalidInputError(f"region: expected a mask of shape {side} with samples inside, got none")
    share = np.ones(n) if rule != "weighted" else np.asarray(weights, dtype=float)
    if share.shape != (n,) or not (share >= 0).all():
        raise InvalidInputError(f"weights: expected zero or more for each of {n} frames")
    maps, shape = index_from_sample(source, voxel_grid), voxel_grid.shape[::-1]
    near = _frames_near(maps, source, voxel_grid, share > 0)
    if not near.size:
        return np.full(shape, np.nan, np.float32), np.zeros(shape, np.uint8)
    first = source.read(int(near[0]))
    if rule == "plus":
        if first.dtype.name not in ("uint8", "float32"):
            raise InvalidInputError(f"rule plus: expected grey levels of 0 to 255, got {first.dtype}")
        mask = mask & ~np.isnan(first)  # outside a fan there is nothing
    kernel, tables = _kernel(splat, rule, shape)
    transpose = rule == "plus" or (first.flags.f_contiguous and not first.flags.c_contiguous)
    if transpose:
        mask, maps = mask.T, maps[:, :, [1, 0, 2]]
    spans = _spans(mask)
    for images, frames in _batches(source, near, first, transpose, rule == "plus"):
        fixed = _fixed_maps(maps[frames], splat, PLUS_BITS if rule == "plus" else POSITION_BITS)
        tag = int(frames[0]) + 1 if rule == "latest" else 0
        samples = Samples(images, share[frames], fixed, spans, tag, splat == "linear")
        _share_out(partial(kernel, samples), tables, fixed, images.shape[1])
    voxels = _levels(rule, tables)
    return voxels, (~np.isnan(voxels)).view(np.uint8)


def _kernel(
    splat: Splat, rule: Rule, shape: tuple[int, ...]
) -> tuple[Callable[..., None], tuple[npt.NDArray[Any], ...]]:
    """Kernel that adds samples to the voxels of a box, with its tables."""
    from speckle3d.kernels import splatting as kernels
    from speckle3d.kernels.whole_levels import add_whole

    if rule == "plus":
        return add_whole, (np.zeros(shape, np.uint8), np.zeros(shape, np.uint16))
    if rule == "maximum":
        return kernels.keep_largest, (np.full(shape, np.nan, np.float32),)
    tags = np.zeros(shape if rule == "latest" else (1, 1, 1), np.uint32)
    return (kernels.add_linear if splat == "linear" else kernels.add_nearest), (np.zeros((*shape, 2)), tags)


def _levels(rule: Rule, tables: tuple[npt.NDArray[Any], ...]) -> Float32Array:
    """Levels of voxels from the accumulated samples; NaN where there was none."""
    table, weights = tables[0], tables[-1]
    if rule == "maximum":
        return np.asarray(table)
    if rule == "plus":
        return np.asarray(np.where(weights > 0, table, np.float32(np.nan)))
    voxels = np.empty(table.shape[:3], np.float32)

    def divide(first: int, stop: int) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            for k in range(first, stop):
                np.divide(table[k, :, :, 0], table[k, :, :, 1], voxels[k], casting="same_kind")

    in_parallel(divide, len(voxels))
    return voxels


def index_from_sample(source: PosedImages, voxel_grid: VoxelGrid) -> FloatArray:
    """Maps from (vector, sample, 1) to fractional voxel indices (i, j, k), shape (n, 3, 3)."""
    grid_from_image = (voxel_grid.world_from_grid.inv() * source.world_from_image).as_matrix()
    maps = (grid_from_image @ source.grid.image_from_sample)[:, :3]
    maps = np.asarray(maps / np.asarray(voxel_grid.spacing_mm)[:, None])
    if not np.isfinite(maps).all():
        raise InvalidInputError("world_from_image: expected finite poses")
    return maps


def _frames_near(
    maps: FloatArray, source: PosedImages, voxel_grid: VoxelGrid, has_weight: BoolArray
) -> IntArray:
    """Frames with a weight that may have a sample within one voxel of the grid."""
    v, s = source.grid.vectors - 1, source.grid.samples - 1
    corners = maps @ np.array([[0, 0, 1], [v, 0, 1], [0, s, 1], [v, s, 1]]).T
    low, high = corners.min(axis=2), corners.max(axis=2)
    near = has_weight & ((high > -1.5) & (low < np.array(voxel_grid.shape) + 0.5)).all(axis=1)
    if (np.maximum(-low, high)[near] > _FARTHEST).any():
        raise InvalidInputError(
            f"images: expected to reach less than {_FARTHEST:.0f} voxels beyond the grid: take larger "
            "voxels, or check the poses"
        )
    return np.flatnonzero(near)


def _batches(
    source: PosedImages, frames: IntArray, first: npt.NDArray[Any], transpose: bool, whole: bool
) -> Iterator[tuple[npt.NDArray[Any], IntArray]]:
    """Read frames a few at a time: images, shape (n, line, sample), and their numbers.

    Images keep the order that the first has in memory: to transpose them takes as long as the work on them.
    With `whole` they become whole grey levels.
    """
    direct = first.dtype.name in _DIRECT and first.dtype.isnative
    kind = np.dtype(np.uint8 if whole else first.dtype if direct else np.float32)
    size = min(max(_BATCH_BYTES // (first.size * kind.itemsize), 1), _BATCH_FRAMES, frames.size)
    images = np.empty((size, *(first.T if transpose else first).shape), kind)

    def read(numbers: IntArray, low: int, stop: int) -> None:
        for n in range(low, stop):
            image = source.read(int(numbers[n]))
            if image.dtype != first.dtype:
                raise MismatchError(
                    f"images[{numbers[n]}]: expected {first.dtype} as the others, got {image.dtype}"
                )
            if whole and image.dtype != np.uint8:
                image = np.nan_to_num(np.rint(image)).clip(0, 255)
            images[n] = image.T if transpose else image

    for start in range(0, frames.size, size):
        numbers = frames[start : start + size]
        if any_thread(source.images):
            in_parallel(partial(read, numbers), numbers.size)
        else:
            read(numbers, 0, numbers.size)
        yield images[: numbers.size], numbers


def _spans(mask: BoolArray) -> IntArray:
    """Runs of samples that count: line, first and end of each, shape (m, 3)."""
    inside = np.pad(mask, ((0, 0), (1, 1)))
    line, first = np.nonzero(inside[:, 1:] & ~inside[:, :-1])
    _, stop = np.nonzero(~inside[:, 1:] & inside[:, :-1])
    return np.stack([line, first, stop], axis=1).astype(np.int64)


def _fixed_maps(maps: FloatArray, splat: Splat, bits: int) -> IntArray:
    """Maps from (line, sample, 1) to positions in units of 2^-40 voxel, rounded to so many bits."""
    fixed = np.rint(maps * 2.0**bits).astype(np.int64)
    if bits == PLUS_BITS:
        ahead = 0.5 if splat == "nearest" else 0.0
    else:
        ahead = 0.5 + _BORDER if splat == "nearest" else 0.5 ** (SHARE_BITS + 1)
    fixed[:, :, 2] += int(ahead * 2.0**bits)
    return np.ascontiguousarray(fixed << (POSITION_BITS - bits))


def _share_out(work: Callable[..., None], tables: tuple[Any, ...], maps: IntArray, lines: int) -> None:
    """Call a function with boxes of voxels that make up the grid, several at once, and with all tables.

    Threads share out voxels, not images: what is added to one comes in the same order. Boxes follow each
    other along the axis along which the lines of images do, so that few lines are cut.
    """
    sides = np.array(tables[0].shape[2::-1])
    extent = np.abs(maps[:, :, 0]).astype(float).mean(axis=0) * lines / 2.0**POSITION_BITS
    axis = int(np.argmax(np.minimum(extent, sides)))

    def part(first: int, stop: int) -> None:
        box = np.stack([np.zeros(3, np.int64), sides], axis=1)
        box[axis] = first, stop
        work(box, *tables)

    count = int(sides[axis])
    in_parallel(part, count, max(_LEAST_BLOCK, -(-count // (2 * cores()))))
