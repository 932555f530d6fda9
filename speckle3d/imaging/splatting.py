"""Images given to the voxels of a block: one accumulator for each way of splatting and rule."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.threads import cores, in_parallel
from speckle3d.imaging.grid import VoxelGrid
from speckle3d.imaging.images import Images, PosedImages
from speckle3d.imaging.settings import Rule, Splat

Weights = npt.NDArray[Any] | Images
"""Weight of each frame, shape (n,), or of each sample: images of weights."""

_DIRECT = ("uint8", "int16", "uint16", "float32")
"""Types that kernels read as they are; others become float32."""
_POSITION_BITS, _SHARE_BITS, _COUNT_BITS = 40, 10, 24
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
        maps = (grid_from_image @ source.image_from_sample)[:, :3]
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
                f"images[{int(np.argmax(far))}]: expected to reach less than {_FARTHEST:.0f} voxels beyond the "
                "grid: take larger voxels, or check the poses"
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
class _Batch:
    """Several frames in memory, as kernels read them.

    Attributes
    ----------
    images : ndarray, shape (n, line, sample)
        Lines are vectors, or with `turned` rows of one depth.
    """

    images: npt.NDArray[Any]
    frames: IntArray
    turned: bool


def _batches(source: PosedImages, frames: IntArray) -> Iterator[_Batch]:
    """Read frames a few at a time, in the type and the order in memory of the first."""
    if frames.size == 0:
        return
    first = source.read_as_stored(int(frames[0]))
    kind = first.dtype if first.dtype.name in _DIRECT and first.dtype.isnative else np.dtype(np.float32)
    turned = first.flags.f_contiguous and not first.flags.c_contiguous
    shape = first.shape[::-1] if turned else first.shape
    size = int(np.clip(_BATCH_BYTES // max(first.size * kind.itemsize, 1), 1, _BATCH_FRAMES))
    stored = first.dtype
    del first
    images = np.empty((min(size, frames.size), *shape), kind)
    for start in range(0, frames.size, size):
        some = frames[start : start + size]
        for n, frame in enumerate(some):
            image = source.read_as_stored(int(frame))
            if image.dtype != stored:
                raise MismatchError(f"images[{frame}]: expected {stored} as the others, got {image.dtype}")
            images[n] = image.T if turned else image
            del image
        yield _Batch(images[: some.size], some, turned)


def _spans(source: PosedImages, mask: BoolArray | None, turned: bool) -> IntArray:
    """Runs of samples that count: line, first and end of each, shape (m, 3)."""
    if mask is None:
        mask = np.ones((source.grid.vectors, source.grid.samples), dtype=bool)
    inside = np.pad(mask.T if turned else mask, ((0, 0), (1, 1)))
    line, first = np.nonzero(inside[:, 1:] & ~inside[:, :-1])
    _, stop = np.nonzero(~inside[:, 1:] & inside[:, :-1])
    return np.ascontiguousarray(np.stack([line, first, stop], axis=1).astype(np.int64))
