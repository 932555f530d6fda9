"""Images given to the voxels of a block: one accumulator for each way of splatting and rule."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.threads import cores, in_parallel
from speckle3d.imaging.images import Images, PosedImages
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.settings import Rule, Splat

Weights = npt.NDArray[Any] | Images
"""Weight of each frame, shape (n,), or of each sample: images of weights."""

_COUNTED, _SUMMED = ("uint8", "int16", "uint16", "float32"), ("uint8", "float32")
"""Types that kernels read as they are, counting and otherwise; others become float32."""
_POSITION_BITS, _SHARE_BITS = 40, 10
"""As the kernels have them."""
_MOST_COUNTED = 2**24
"""Samples in a voxel for which sum and count fit into one word."""
_BORDER = 2.0**-24
"""Voxels. A sample less than this below a border lies on it, and belongs to the voxel above."""
_FARTHEST = 2.0**22
"""Voxels from the grid's first, so that positions fit in 64 bits."""
_BATCH_BYTES, _BATCH_FRAMES = 2**25, 32
"""Frames worked on together: enough that threads are not started for each."""
_BLOCKS_PER_CORE = 2
_LEAST_BLOCK = 16
"""Voxels: below, cutting lines to blocks takes longer than another thread saves."""


@dataclass(frozen=True)
class Placed:
    """Images, their place on a grid of voxels, and which of their samples count.

    Parameters
    ----------
    source : PosedImages
    index_from_sample : ndarray, shape (n, 3, 3)
        From (vector, sample, 1) to fractional voxel indices (i, j, k).
    weights : ndarray, shape (n,), or images of weights, optional
    mask : ndarray of bool, shape (vector, sample), optional
        Samples that count.
    """

    source: PosedImages
    index_from_sample: FloatArray
    weights: Weights | None = None
    mask: BoolArray | None = None

    @classmethod
    def on(
        cls,
        voxel_grid: VoxelGrid,
        source: PosedImages,
        weights: Weights | None = None,
        mask: BoolArray | None = None,
    ) -> Placed:
        """Place images on a grid.

        Raises
        ------
        MismatchError
            If there is not one weight per frame, or the mask is not of the images' shape.
        InvalidInputError
            If a pose or a weight is not finite, or no sample counts.
        """
        grid_from_image = (voxel_grid.world_from_grid.inv() * source.world_from_image).as_matrix()
        maps = (grid_from_image @ source.grid.image_from_sample)[:, :3]
        maps = maps / np.asarray(voxel_grid.spacing_mm)[:, None]
        if not np.isfinite(maps).all():
            bad = int(np.flatnonzero(~np.isfinite(maps).all(axis=(1, 2)))[0])
            raise InvalidInputError(f"world_from_image[{bad}]: expected a finite pose, got {maps[bad]}")
        return cls(source, maps, _checked_weights(weights, len(source)), _checked_mask(mask, source))

    def touching(self, box: IntArray) -> IntArray:
        """Frames that may have a sample within one voxel of a box of voxels, shape (3, 2).

        Raises
        ------
        InvalidInputError
            If such a frame reaches farther from the grid than positions can tell.
        """
        v, s = self.source.grid.vectors - 1, self.source.grid.samples - 1
        corners = self.index_from_sample @ np.array([[0, 0, 1], [v, 0, 1], [0, s, 1], [v, s, 1]]).T
        low, high = corners.min(axis=2), corners.max(axis=2)
        near = ((high > box[:, 0] - 1.5) & (low < box[:, 1] + 0.5)).all(axis=1)
        far = near & (np.maximum(-low, high) > _FARTHEST).any(axis=1)
        if far.any():
            raise InvalidInputError(
                f"images[{int(np.argmax(far))}]: expected to reach less than {_FARTHEST:.0f} voxels beyond "
                "the grid: take larger voxels, or check the poses"
            )
        return np.flatnonzero(near)


def _checked_weights(weights: Weights | None, frames: int) -> Weights | None:
    if isinstance(weights, np.ndarray) and weights.ndim == 1:
        if weights.shape != (frames,):
            raise MismatchError(f"weights: expected {frames}, one per frame, got {weights.size}")
        if not (np.isfinite(weights) & (weights >= 0)).all():
            bad = int(np.flatnonzero(~(np.isfinite(weights) & (weights >= 0)))[0])
            raise InvalidInputError(f"weights[{bad}]: expected zero or above, got {weights[bad]}")
    return weights


def _checked_mask(mask: BoolArray | None, source: PosedImages) -> BoolArray | None:
    if mask is None:
        return None
    expected = (source.grid.vectors, source.grid.samples)
    if mask.shape != expected:
        raise MismatchError(f"region: expected a mask of shape {expected}, got {mask.shape}")
    if not mask.any():
        raise InvalidInputError("region: expected samples of the image inside, got none")
    return mask


@dataclass(frozen=True)
class Batch:
    """Several frames in memory, as kernels read them.

    Attributes
    ----------
    images : ndarray, shape (n, line, sample)
        Lines are vectors, or with `turned` rows of one depth.
    """

    images: npt.NDArray[Any]
    frames: IntArray
    turned: bool


def batches(
    source: PosedImages, frames: IntArray, direct: tuple[str, ...], by_row: bool = False
) -> Iterator[Batch]:
    """Read frames a few at a time, in the type of the first if it is direct, and in its order or by rows."""
    if frames.size == 0:
        return
    first = source.read_as_stored(int(frames[0]))
    kind = first.dtype if first.dtype.name in direct and first.dtype.isnative else np.dtype(np.float32)
    turned = by_row or (first.flags.f_contiguous and not first.flags.c_contiguous)
    shape = first.shape[::-1] if turned else first.shape
    size = min(max(_BATCH_BYTES // (first.size * kind.itemsize), 1), _BATCH_FRAMES)
    stored = first.dtype
    del first
    images = np.empty((min(size, frames.size), *shape), kind)
    for start in range(0, frames.size, size):
        some = frames[start : start + size]
        read = partial(_read_into, images, source, some, stored, turned)
        if source.any_thread:
            in_parallel(read, some.size)
        else:
            read(0, some.size)
        yield Batch(images[: some.size], some, turned)


def _read_into(
    images: npt.NDArray[Any],
    source: PosedImages,
    frames: IntArray,
    stored: np.dtype[Any],
    turned: bool,
    first: int,
    stop: int,
) -> None:
    """Read some of the frames, from `first` to before `stop`."""
    for n in range(first, stop):
        image = source.read_as_stored(int(frames[n]))
        if image.dtype != stored:
            raise MismatchError(f"images[{frames[n]}]: expected {stored} as the others, got {image.dtype}")
        images[n] = image.T if turned else image
        del image


def batch_gb(source: PosedImages) -> float:
    """Memory for frames and their weights in hand, GB."""
    samples = source.grid.vectors * source.grid.samples
    frames = min(len(source), max(_BATCH_BYTES // samples, 1), _BATCH_FRAMES)
    return 2 * 4 * samples * (frames + 1) / 1e9


def spans_of(source: PosedImages, mask: BoolArray | None, turned: bool) -> IntArray:
    """Runs of samples that count: line, first and end of each, shape (m, 3)."""
    if mask is None:
        mask = np.ones((source.grid.vectors, source.grid.samples), dtype=bool)
    inside = np.pad(mask.T if turned else mask, ((0, 0), (1, 1)))
    line, first = np.nonzero(inside[:, 1:] & ~inside[:, :-1])
    _, stop = np.nonzero(~inside[:, 1:] & inside[:, :-1])
    return np.ascontiguousarray(np.stack([line, first, stop], axis=1).astype(np.int64))


class Accumulator:
    """What images give to the voxels of a block of planes, by one way of splatting and one rule.

    Parameters
    ----------
    shape : tuple of int
        Voxels of the block along k, j and i.
    kind : dtype
        Of the images, as kernels read them.
    splat : {"nearest", "linear"}
    rule : {"mean", "maximum", "latest", "weighted"}
    countable : bool
        Whether whole levels can be summed in one word with their number: see `countable`.
    """

    def __init__(
        self, shape: tuple[int, int, int], kind: np.dtype[Any], splat: Splat, rule: Rule, countable: bool
    ) -> None:
        self.shape, self.splat, self.rule = shape, splat, rule
        self.counts = countable and kind.kind in "iu"
        self._offset = 2**15 if kind.kind == "i" else 0
        self._table = self._empty_table()
        self._tags = np.zeros(shape if rule == "latest" else (1, 1, 1), np.uint32)

    def _empty_table(self) -> npt.NDArray[Any]:
        if self.rule == "maximum":
            return np.full(self.shape, np.nan, np.float32)
        return np.zeros(self.shape, np.uint64) if self.counts else np.zeros((*self.shape, 2))

    def add(
        self,
        images: npt.NDArray[Any],
        weights: Float32Array,
        maps: IntArray,
        spans: IntArray,
        first_tag: int,
    ) -> None:
        """Add images, shape (n, line, sample), whose maps are fixed-point ones from `fixed_maps`."""
        from speckle3d.kernels import splatting as kernels

        tag = first_tag if self.rule == "latest" else 0

        def work(box: IntArray) -> None:
            if self.rule == "maximum":
                raised = kernels.raise_nearest if self.splat == "nearest" else kernels.raise_linear
                raised(images, maps, spans, box, self._table)
            elif self.counts:
                kernels.count_nearest(images, maps, spans, box, self._offset, self._table)
            else:
                added = kernels.add_nearest if self.splat == "nearest" else kernels.add_linear
                added(images, weights, maps, spans, box, tag, self._table, self._tags)

        share_out(work, self.shape, maps, images.shape[1:])

    def finish(self) -> tuple[Float32Array, ByteArray]:
        """Voxels, NaN where no sample was, and their states; both of shape (n_k, n_j, n_i)."""
        from speckle3d.kernels import splatting as kernels

        if self.rule == "maximum":
            return self._table, (~np.isnan(self._table)).view(np.uint8)
        voxels, state = np.empty(self.shape, np.float32), np.empty(self.shape, np.uint8)

        def work(first: int, stop: int) -> None:
            part = slice(first, stop)
            if self.counts:
                kernels.means_of_counts(self._table[part], self._offset, voxels[part], state[part])
            else:
                kernels.means_of_sums(self._table[part], voxels[part], state[part])

        in_parallel(work, self.shape[0])
        return voxels, state


def bytes_per_voxel(splat: Splat, rule: Rule) -> int:
    """Memory that voxels on the way and what becomes of them take at most, bytes per voxel."""
    if rule == "plus":
        return 8
    if rule == "maximum":
        return 5
    return 16 + 5 + (4 if rule == "latest" else 0)


def fixed_maps(index_from_sample: FloatArray, splat: Splat, first_plane: int, turned: bool) -> IntArray:
    """Maps from (line, sample, 1) to positions in units of 2^-40 voxel, planes counted from `first_plane`."""
    maps = index_from_sample[:, :, [1, 0, 2]] if turned else index_from_sample
    fixed = np.rint(maps * 2.0**_POSITION_BITS).astype(np.int64)
    ahead = 0.5 + _BORDER if splat == "nearest" else 0.5 ** (_SHARE_BITS + 1)
    fixed[:, :, 2] += int(ahead * 2.0**_POSITION_BITS)
    fixed[:, 2, 2] -= first_plane << _POSITION_BITS
    return np.ascontiguousarray(fixed)


def share_out(
    work: Callable[[IntArray], None],
    shape: tuple[int, int, int],
    maps: IntArray,
    image_shape: tuple[int, ...],
) -> None:
    """Call a function with boxes of voxels that make up a block of (n_k, n_j, n_i), several at once.

    Threads share out voxels, not images: what is added to one comes in the same order.
    """
    whole = np.array([[0, n] for n in shape[::-1]], dtype=np.int64)
    axis = _common_axis(maps, image_shape, whole)

    def part(first: int, stop: int) -> None:
        box = whole.copy()
        box[axis] = first, stop
        work(box)

    count = int(whole[axis, 1])
    in_parallel(part, count, max(_LEAST_BLOCK, -(-count // (_BLOCKS_PER_CORE * cores()))))


def _common_axis(maps: IntArray, shape: tuple[int, ...], box: IntArray) -> int:
    """Axis of the voxels along which the lines of images follow each other most: few are cut there."""
    extent = np.abs(maps[:, :, 0]).astype(float) * shape[0] / 2.0**_POSITION_BITS
    shared = np.minimum(extent / box[:, 1], 1.0).mean(axis=0)
    return int(np.argmax(shared * np.minimum(box[:, 1], _LEAST_BLOCK * 4)))


def splat_block(
    placed: Placed, voxel_grid: VoxelGrid, splat: Splat, rule: Rule, first: int, stop: int
) -> tuple[Float32Array, ByteArray]:
    """Give images to the voxels of some planes.

    Parameters
    ----------
    placed : Placed
        On `voxel_grid`.
    voxel_grid : VoxelGrid
    splat, rule
        As `CompoundingSettings` has them.
    first, stop : int
        Planes along k.

    Returns
    -------
    voxels : ndarray of float32, shape (stop - first, n_j, n_i)
        NaN where no sample was.
    state : ndarray of uint8
        1 where one was, else 0.
    """
    n_i, n_j, _ = voxel_grid.shape
    box = np.array([[0, n_i], [0, n_j], [first, stop]], dtype=np.int64)
    accumulator = None
    packed = countable(placed, splat, rule)
    for batch in batches(placed.source, placed.touching(box), _COUNTED if packed else _SUMMED):
        if accumulator is None:
            accumulator = Accumulator((stop - first, n_j, n_i), batch.images.dtype, splat, rule, packed)
            spans = spans_of(placed.source, placed.mask, batch.turned)
        maps = fixed_maps(placed.index_from_sample[batch.frames], splat, first, batch.turned)
        weights = _weights_of(placed, batch) if rule == "weighted" else _ones(batch)
        accumulator.add(batch.images, weights, maps, spans, int(batch.frames[0]) + 1)
    if accumulator is None:
        shape = (stop - first, n_j, n_i)
        return np.full(shape, np.nan, np.float32), np.zeros(shape, np.uint8)
    return accumulator.finish()


def countable(placed: Placed, splat: Splat, rule: Rule) -> bool:
    """Whether samples are only counted and summed, and so few in a voxel that both fit in one word."""
    return splat == "nearest" and rule == "mean" and _most_samples(placed) < _MOST_COUNTED


def _most_samples(placed: Placed) -> float:
    """Upper bound of the samples of all frames in one voxel."""
    across, along = np.moveaxis(placed.index_from_sample[:, :, :2], 2, 0)
    area = float(np.linalg.norm(np.cross(across, along), axis=1).min())
    steps = np.array([np.linalg.norm(each, axis=1).max() for each in (across, along)])
    # Cells of the samples that a voxel's cut, at most its diagonal wide, can touch.
    reach = np.sqrt(3.0) + steps.sum()
    grid = placed.source.grid
    return float(len(placed.source)) * min(grid.vectors * grid.samples, float(reach) ** 2 / max(area, 1e-12))


def _ones(batch: Batch) -> Float32Array:
    return _constant(np.ones(len(batch.frames), np.float32), batch)


def _constant(weights: Float32Array, batch: Batch) -> Float32Array:
    """One weight per frame as images, without memory for them."""
    return np.lib.stride_tricks.as_strided(weights, batch.images.shape, (weights.strides[0], 0, 0))


def _weights_of(placed: Placed, batch: Batch) -> Float32Array:
    """Weights of the samples of a batch, shape (n, line, sample)."""
    weights = placed.weights
    if weights is None:
        raise InvalidInputError(
            "weights: expected one per frame, or images of them, with the rule 'weighted'"
        )
    if isinstance(weights, np.ndarray) and weights.ndim == 1:
        return _constant(np.ascontiguousarray(weights[batch.frames], np.float32), batch)
    source = PosedImages(weights, placed.source.grid, placed.source.world_from_image)
    read = [source.read(int(frame)) for frame in batch.frames]
    some = np.stack([each.T for each in read] if batch.turned else read)
    # In the layout of the constant ones, for which the kernels are compiled.
    return np.lib.stride_tricks.as_strided(some, some.shape, some.strides)
