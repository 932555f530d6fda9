"""Voxels of a sweep into files: ``speckle3d volume`` and ``reconstruct --volume``."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.grid import ImageGrid, Region
from speckle3d.core.poses import PoseErrors
from speckle3d.core.volume import EMPTY, FILLED, MEASURED, STATE_SEGMENTS, LabelMap, Volume
from speckle3d.imaging.axes import principal_axes, sweep_axes
from speckle3d.imaging.measures.uncertainty import deviation_volume
from speckle3d.imaging.voxels.grid import VoxelGrid, grid_around, spacing_within
from speckle3d.imaging.voxels.settings import CompoundingSettings
from speckle3d.imaging.voxels.volume import compound_onto
from speckle3d.io.voxels.volumes import read_volume, write_volume
from speckle3d.study.pose_errors import errors_of
from speckle3d.study.posed import MARK, PosedSweep, pose_mark

_DEVIATION = "standard deviation of position along the sweep, mm"

Axes = Literal["sweep", "world", "principal"]


class GridRequest(BaseModel):
    """Requested grid of voxels, whole or in part.

    Attributes
    ----------
    axes : {"sweep", "world", "principal"}
        Along the images' mean lateral, axial and elevational direction; the world's axes; or those of the
        smallest box.
    spacing_mm : tuple of float, optional
        Along i, j and k; by default the same along each, that of the settings.
    origin_mm : tuple of float, optional
        Centre of the first voxel in the world; by default the grid begins where the images do.
    shape : tuple of int, optional
        Voxels along i, j and k; by default the grid reaches to where the images end.
    size_mm : tuple of float, optional
        Instead of `shape`: sizes along i, j and k from outer side to outer side.
    within_gb : float, optional
        Instead of `spacing_mm`: the finest round one with which voxels that hold the images take no more.
    like : path, optional
        A volume whose grid to take instead of all this.
    """

    model_config = ConfigDict(frozen=True)

    axes: Axes = "sweep"
    spacing_mm: tuple[float, float, float] | None = None
    origin_mm: tuple[float, float, float] | None = None
    shape: tuple[int, int, int] | None = None
    size_mm: tuple[float, float, float] | None = None
    within_gb: float | None = None
    like: Path | None = None

    def grid(
        self, images: ImageGrid, world_from_image: RigidTransform, settings: CompoundingSettings
    ) -> VoxelGrid:
        """Grid for a sweep's images, or for a part of each.

        Raises
        ------
        InvalidInputError
            If a size is given in both voxels and mm, or a value is not what it must be.
        """
        if self.like is not None:
            like = read_volume(self.like)
            return VoxelGrid(like.shape, like.spacing_mm, like.world_from_grid)
        axes = Rotation.identity()
        if self.axes != "world":
            is_smallest = self.axes == "principal"
            axes = principal_axes(images, world_from_image) if is_smallest else sweep_axes(world_from_image)
        spacing: float | tuple[float, float, float] = self.spacing_mm or settings.voxel_mm
        if self.within_gb is not None:
            bound = self.within_gb, axes, settings.voxel_type, self.origin_mm, self.size_mm
            spacing = spacing_within(images, world_from_image, *bound)
        place = self.model_dump(include={"origin_mm", "shape", "size_mm"})
        return grid_around(images, world_from_image, spacing, axes, **place)


@dataclass(frozen=True)
class VolumeReport:
    """A volume that was written.

    Attributes
    ----------
    counts : ndarray of int, shape (3,)
        Voxels that are empty, measured and filled.
    seconds : float
        Run time.
    """

    path: Path
    mode: str
    grid: VoxelGrid
    counts: IntArray
    seconds: float

    @property
    def shares(self) -> dict[str, float]:
        """Share of the voxels in each state."""
        parts = (self.counts / self.counts.sum()).tolist()
        return {"measured": parts[MEASURED], "filled": parts[FILLED], "empty": parts[EMPTY]}

    def summary(self) -> dict[str, Any]:
        """Summary as JSON."""
        return {
            "file": str(self.path),
            "size_bytes": self.path.stat().st_size,
            "mode": self.mode,
            "shape": list(self.grid.shape),
            "spacing_mm": list(self.grid.spacing_mm),
            "world_from_grid": self.grid.world_from_grid.as_matrix().tolist(),
            **self.shares,
            "seconds": self.seconds,
        }

    @property
    def line(self) -> str:
        """File, size, voxels, and the share of each state in one line."""
        shares = ", ".join(f"{100 * share:.1f} % {word}" for word, share in self.shares.items())
        size = f"{self.path.stat().st_size / 1e6:.3g} MB"
        return f"{self.path}: {size}, mode {self.mode}, {self.grid}: {shares}; {self.seconds:.1f} s"


def write_voxels(
    posed: PosedSweep,
    settings: CompoundingSettings,
    out: Path,
    grid_request: GridRequest | None = None,
    region: Region | None = None,
    state_path: Path | None = None,
    deviation_path: Path | None = None,
) -> VolumeReport:
    """Compound a sweep's images and write the volume.

    Parameters
    ----------
    posed : PosedSweep
    settings : CompoundingSettings
    out : path
        With a suffix of `speckle3d.io.voxels.volumes.SUFFIXES`.
    grid_request : GridRequest, optional
        By default cubic voxels along the sweep that hold it.
    region : Region, optional
        Of the images; samples outside it do not count.
    state_path : path, optional
        Where to write which voxels are measured and filled, as labels.
    deviation_path : path, optional
        Where to write each voxel's standard deviation of position along the sweep, mm.

    Raises
    ------
    InvalidInputError
        If a part of what is asked for is not what it must be.
    InsufficientDataError
        If no sample of the images lies in the grid, or the rule "weighted" finds no claimed errors.
    FileError
        If a file cannot be written.
    """
    began = time.perf_counter()
    levels = None if settings.levels == "auto" else settings.levels
    source, meaning = posed.source(levels, settings.dynamic_range_db)
    mask = region.mask(source.grid) if region else None
    part = source.grid if mask is None else masked_part(source.grid, mask)
    grid = (grid_request or GridRequest()).grid(part, source.world_from_image, settings)
    weights = confidence(posed, grid) if settings.rule == "weighted" and settings.backward_mm == 0 else None
    fields = fields_of(posed, settings, meaning)
    volume = compound_onto(grid, source, settings, weights, mask)
    place, state = (grid.spacing_mm, grid.world_from_grid), volume.state.T
    write_volume(out, Volume(volume.voxels, *place, fields))
    if state_path is not None:
        write_volume(state_path, LabelMap(volume.state, *place, fields, STATE_SEGMENTS))
    if deviation_path is not None:
        errors = _errors(posed, "the deviation of position")
        deviation, words = deviation_volume(errors, source.grid, grid, state), fields | {"levels": _DEVIATION}
        write_volume(deviation_path, Volume(deviation.T, *place, words))
    counts, seconds = np.bincount(state.ravel(), minlength=3), time.perf_counter() - began
    return VolumeReport(out, posed.mode, grid, counts, seconds)


def _errors(posed: PosedSweep, purpose: str) -> PoseErrors:
    """Claimed errors of a reconstruction's poses.

    Raises
    ------
    InsufficientDataError
        If nothing says how well the frames' places are known.
    """
    if posed.reconstruction is None:
        raise InsufficientDataError(
            f"{posed.sweep.name}: {purpose}: expected a reconstruction with claimed errors, got a recording"
        )
    return errors_of(posed.reconstruction, posed.mode)


def confidence(posed: PosedSweep, grid: VoxelGrid) -> FloatArray:
    """Weight of each frame, shape (n,): one over the variance of its place along the sweep and in a voxel.

    Along the sweep is the first frame's elevational axis, as of the errors; the largest weight is one.

    Raises
    ------
    InsufficientDataError
        If nothing says how well the frames' places are known.
    """
    errors = _errors(posed, "rule weighted")
    along = grid.world_from_grid.rotation.inv().apply(posed.world_from_image[0].rotation.apply([0, 0, 1]))
    in_voxel = np.square(along * grid.spacing_mm).sum() / 12  # of a place that is anywhere in it
    place = (errors.factors[:, :, 2] ** 2).sum(axis=0) + in_voxel
    return np.asarray(place.min() / place)


def fields_of(posed: PosedSweep, settings: CompoundingSettings, meaning: str) -> dict[str, str]:
    """Fields of a volume's file."""
    method = {"method": f"between the nearest images, up to {settings.backward_mm:g} mm away"}
    if settings.backward_mm == 0:
        radius = f"{settings.fill_mm:g} mm" if settings.fill_mm > 0 else f"{settings.fill_radius} voxels"
        method = {"splat": settings.splat, "rule": settings.rule, "fill_radius": radius}
    return {
        "levels": meaning,
        "poses": posed.mode,
        MARK: pose_mark(posed.world_from_image),
        **method,
        "recording": posed.sweep.name,
        "made_by": f"speckle3d {version('speckle3d')}",
    }


def masked_part(grid: ImageGrid, mask: BoolArray) -> ImageGrid:
    """Smallest rectangle of an image of parallel vectors that holds a mask, shape (vector, sample).

    A grid of voxels around it has no room for what does not count.
    """
    inside = np.argwhere(mask)
    first, last = inside.min(axis=0), inside.max(axis=0)
    wide, high = (last - first + 1).tolist()
    left, top = grid.mm(*first).tolist()
    return replace(grid, vectors=wide, samples=high, first_vector_mm=left, first_sample_depth_mm=top)
