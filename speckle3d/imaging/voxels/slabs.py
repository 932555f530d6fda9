"""Volumes made in slabs of planes: larger than memory, and the same whatever the slabs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, ByteArray, Float32Array, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.threads import in_parallel
from speckle3d.imaging.images import PosedImages
from speckle3d.imaging.voxels.backward import BYTES_PER_VOXEL, backward_slabs
from speckle3d.imaging.voxels.grid import Slab, VoxelGrid, even_planes
from speckle3d.imaging.voxels.holes import boxes_within, cubes_within, fill_holes
from speckle3d.imaging.voxels.settings import CompoundingSettings, VoxelType
from speckle3d.imaging.voxels.splatting import Placed, Weights, batch_gb, bytes_per_voxel, splat_block
from speckle3d.imaging.voxels.whole_levels import splat_block_whole

_SHARE = 0.8
"""Of the memory; the rest is for the interpreter, its libraries, and files being read and packed."""
_LEAST_PLANES = 8
"""Thinner slabs read frames too often, and work more on their neighbours' planes than on their own."""


def compound_slabs(
    source: PosedImages,
    voxel_grid: VoxelGrid,
    settings: CompoundingSettings | None = None,
    weights: Weights | None = None,
    region: BoolArray | None = None,
) -> Iterator[Slab]:
    """Compound images into voxels, a slab of planes along k at a time.

    Joined slabs equal the whole to the last bit, whatever the memory and the number of threads. Each slab
    reads the frames that touch it.

    Parameters
    ----------
    source : PosedImages
    voxel_grid : VoxelGrid
    settings : CompoundingSettings, optional
        `voxel_mm`, `levels` and `dynamic_range_db` are not read: the grid and the images have them. With
        `backward_mm` neither are `splat`, `rule` and the filling's.
    weights : ndarray of shape (n,), or images of weights, optional
        For the rule "weighted"; samples whose weight is 0 or NaN do not count.
    region : ndarray of bool, shape (vector, sample), optional
        Samples that count; by default all.

    Yields
    ------
    Slab
        In order along k.

    Raises
    ------
    InvalidInputError
        If the volume is larger than `max_file_gb`, not even a thin slab fits into `max_memory_gb`, or an
        input is not what it must be.
    """
    chosen = settings or CompoundingSettings()
    if (size := voxel_grid.size_gb(chosen.voxel_type)) > chosen.max_file_gb:
        raise InvalidInputError(
            f"volume: expected at most {chosen.max_file_gb:g} GB, got {size:.3g} GB for {voxel_grid}: take "
            "larger voxels, or check the poses"
        )
    if chosen.backward_mm > 0:
        for slab in backward_slabs(source, voxel_grid, chosen.backward_mm, region, chosen.max_memory_gb):
            yield Slab(slab.first, as_type(slab.voxels, slab.state, chosen.voxel_type), slab.state)
        return
    if chosen.rule == "plus" and chosen.voxel_type != "uint8":
        raise InvalidInputError(
            "rule plus: expected voxels of type uint8, whose whole grey levels it keeps, got "
            f"{chosen.voxel_type}"
        )
    placed = Placed.on(voxel_grid, source, weights, region)
    planes = planes_per_slab(voxel_grid, chosen, batch_gb(source))
    for first in range(0, voxel_grid.shape[2], planes):
        yield _slab(placed, voxel_grid, chosen, first, min(first + planes, voxel_grid.shape[2]))


def planes_per_slab(voxel_grid: VoxelGrid, settings: CompoundingSettings, frames_gb: float) -> int:
    """Planes of one slab, so that work on it stays within `max_memory_gb` beside the frames in hand.

    Raises
    ------
    InvalidInputError
        If less than a thin slab would.
    """
    n_i, n_j, n_k = voxel_grid.shape
    around, most = 2 * _halo(boxes_of(voxel_grid, settings)), settings.max_memory_gb
    if working_gb(voxel_grid, settings, frames_gb) <= most:
        return n_k
    # Whoever takes the slabs still has the one before.
    held = n_i * n_j * (np.dtype(settings.voxel_type).itemsize + 1) / 1e9
    plane_gb = _plane_gb(voxel_grid, settings) + held
    planes = int((_SHARE * most - frames_gb) / plane_gb) - around
    if planes < min(_LEAST_PLANES, n_k):
        needed = ((min(_LEAST_PLANES, n_k) + around) * plane_gb + frames_gb) / _SHARE
        raise InvalidInputError(
            f"volume: expected to work within {most:g} GB of memory, but a slab of {n_i} x {n_j} voxels "
            f"takes {needed:.3g} GB: take larger voxels, or allow more memory"
        )
    return even_planes(n_k, planes)


def working_gb(voxel_grid: VoxelGrid, settings: CompoundingSettings, frames_gb: float) -> float:
    """Memory to make all of a volume at once, the volume and frames in hand included, GB."""
    return (voxel_grid.shape[2] * _plane_gb(voxel_grid, settings) + frames_gb) / _SHARE


def _plane_gb(voxel_grid: VoxelGrid, settings: CompoundingSettings) -> float:
    size = np.dtype(settings.voxel_type).itemsize
    n_i, n_j, _ = voxel_grid.shape
    splatting = bytes_per_voxel(settings.splat, settings.rule)
    return n_i * n_j * ((BYTES_PER_VOXEL if settings.backward_mm > 0 else splatting) + size) / 1e9


def _slab(
    placed: Placed, voxel_grid: VoxelGrid, settings: CompoundingSettings, first: int, stop: int
) -> Slab:
    boxes = boxes_of(voxel_grid, settings)
    below, above = max(first - _halo(boxes), 0), min(stop + _halo(boxes), voxel_grid.shape[2])
    if settings.rule == "plus":
        voxels, state = splat_block_whole(placed, voxel_grid, settings.splat, below, above)
    else:
        voxels, state = splat_block(placed, voxel_grid, settings.splat, settings.rule, below, above)
    fill_holes(voxels, state, boxes, first - below, stop - below)
    own = slice(first - below, stop - below)
    return Slab(first, as_type(voxels[own], state[own], settings.voxel_type), state[own])


def boxes_of(voxel_grid: VoxelGrid, settings: CompoundingSettings) -> IntArray:
    """Boxes from which holes are filled, smallest first, shape (n, 3): half edges along k, j and i."""
    if settings.fill_mm > 0:
        return boxes_within(settings.fill_mm, voxel_grid.spacing_mm)
    return cubes_within(settings.fill_radius)


def _halo(boxes: IntArray) -> int:
    """Planes beyond a slab that boxes reach."""
    return int(boxes[:, 0].max(initial=0))


def as_type(voxels: Float32Array, state: ByteArray, voxel_type: VoxelType) -> npt.NDArray[Any]:
    """Voxels rounded and clipped to a type, empty ones 0; as they are in float32, with NaN for empty."""
    if voxel_type == "float32":
        return voxels
    from speckle3d.kernels.splatting import round_voxels

    limits = np.iinfo(voxel_type)
    out = np.empty(voxels.shape, voxel_type)

    def work(first: int, stop: int) -> None:
        part = slice(first, stop)
        round_voxels(voxels[part], state[part], float(limits.min), float(limits.max), out[part])

    in_parallel(work, len(voxels))
    return out
