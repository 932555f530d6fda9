"""The grid of patches on an image: equal in millimetres, whatever the image's width."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.grid import REGION_HELP, ImageGrid, Region


class PatchSettings(BaseModel):
    """Size of the patches whose speckle is correlated.

    Fixed in millimetres: decorrelation curves belong to a patch size, not to an image width.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    width_mm: float = Field(3.6, gt=0, description="Lateral side of a patch.")
    height_mm: float = Field(3.0, gt=0, description="Axial side of a patch.")
    top_mm: float = Field(2.0, ge=0, description="Depth above which nothing is used: the near field.")
    region: str = Field(
        "", description=f"Part of the image whose patches are used: {REGION_HELP}; empty: the whole image."
    )


@dataclass(frozen=True)
class PatchGrid:
    """Patches that tile an image.

    Attributes
    ----------
    first : ndarray, shape (p, 2)
        First vector and sample of each patch.
    size : ndarray, shape (2,)
        Vectors and samples in a patch.
    centre_mm : ndarray, shape (p, 2)
        Lateral and axial position of each patch's centre.
    depth_mm : ndarray, shape (p,)
        Of each patch's centre along its vector, from the array's face.
    angle_rad : ndarray, shape (p,)
        Of the vector there, from straight down and towards growing x: 0 but in a fan.
    pitch_mm : ndarray, shape (p,)
        Distance of neighbouring vectors there.
    spacing_mm : ndarray, shape (2,)
        Vector pitch, of a fan at its middle depth, and sample spacing.
    inside : ndarray of bool, shape (p,)
        Patches in the region that counts.
    region : ndarray of bool, shape (vector, sample)
        Samples of the image in it.
    step_rad : float
        Angle between neighbouring vectors.
    """

    first: IntArray
    size: IntArray
    centre_mm: FloatArray
    depth_mm: FloatArray
    angle_rad: FloatArray
    pitch_mm: FloatArray
    spacing_mm: FloatArray
    inside: BoolArray
    region: BoolArray
    step_rad: float = 0.0

    def __len__(self) -> int:
        return int(self.first.shape[0])

    @property
    def row_depth_mm(self) -> FloatArray:
        """Depth of the centres of each row of patches, shape (r,), increasing."""
        return np.unique(self.depth_mm)

    def rows_of(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values of patches, shape (..., p), as rows and columns, shape (..., r, c)."""
        by_column = values.reshape(*values.shape[:-1], -1, self.row_depth_mm.size)
        return np.asarray(by_column.swapaxes(-1, -2))

    def tiles(self, image: npt.NDArray[Any], step: int = 1) -> npt.NDArray[Any]:
        """Patches of an image, shape (..., vector, sample), as (p, ..., v, s), of every step-th sample."""
        windows = np.lib.stride_tricks.sliding_window_view(image, self.size, axis=(-2, -1))[..., ::step]
        return np.moveaxis(windows[..., self.first[:, 0], self.first[:, 1], :, :], -3, 0)

    def between(self, depth_mm: FloatArray) -> PatchGrid:
        """Keep the rows whose centres lie between the first and the last of some depths, or half a patch off.

        Raises
        ------
        MismatchError
            If that is less than half of the rows, or one row alone.
        """
        rows, half = self.row_depth_mm, float(self.size[1] * self.spacing_mm[1]) / 2
        low, high = float(depth_mm[0]), float(depth_mm[-1])
        inside = (rows >= low - half) & (rows <= high + half)
        if inside.sum() < max(2, rows.size / 2):
            raise MismatchError(
                f"the curves do not match the sweep: expected patches at the curves' depths of {low:.1f} to "
                f"{high:.1f} mm, got {rows[0]:.1f} to {rows[-1]:.1f} mm, {inside.sum()} of {rows.size} rows "
                "between them"
            )
        patches = np.isin(self.depth_mm, rows[inside])
        names = ("first", "centre_mm", "depth_mm", "angle_rad", "pitch_mm", "inside")
        return replace(self, **{name: getattr(self, name)[patches] for name in names})


def lay_patches(grid: ImageGrid, settings: PatchSettings | None = None) -> PatchGrid:
    """Tile the image with as many whole patches as fit, centred laterally.

    Raises
    ------
    InvalidInputError
        If not one column or not two rows of patches fit, or the region holds none of them.
    """
    s = settings or PatchSettings()
    spacing = np.array([grid.vector_pitch_mm, grid.sample_spacing_mm])
    size = np.maximum(np.rint(np.array([s.width_mm, s.height_mm]) / spacing), 3).astype(np.int64)
    top = max(0, int(np.ceil((s.top_mm - grid.first_sample_depth_mm) / grid.sample_spacing_mm)))
    columns = grid.vectors // size[0]
    rows = (grid.samples - top) // size[1]
    if columns < 1 or rows < 2:
        raise InvalidInputError(
            f"expected an image that holds 1 x 2 patches of {s.width_mm:g} x {s.height_mm:g} mm below "
            f"{s.top_mm:g} mm, got {grid.width_mm:.1f} mm wide and {grid.depth_mm:.1f} mm deep"
        )
    left = (grid.vectors - columns * size[0]) // 2
    v, d = np.meshgrid(left + size[0] * np.arange(columns), top + size[1] * np.arange(rows), indexing="ij")
    everywhere = np.ones((grid.vectors, grid.samples), dtype=bool)
    region = Region(s.region).mask(grid) if s.region else everywhere
    first = np.stack([v.ravel(), d.ravel()], axis=1).astype(np.int64)
    # Most of a patch must lie in the region.
    inside = np.array([region[v : v + size[0], d : d + size[1]].mean() >= 0.5 for v, d in first])
    rows_inside = inside.reshape(columns, rows).any(axis=0)
    if (count := rows_inside.sum()) < 2:
        raise InvalidInputError(f"region: expected two rows of patches in it, got {count}: {s.region}")
    selection = np.tile(rows_inside, columns)
    first, inside = first[selection], inside[selection]
    vector, sample = (first + (size - 1) / 2).T
    depth, angle = grid.first_sample_depth_mm + sample * spacing[1], grid.angle_rad(vector)
    pitch, step = np.full(len(first), spacing[0]), 0.0
    if grid.fan is not None:
        step = grid.fan.step_rad
        pitch = (grid.fan.radius_mm + depth) * step
    centre_mm = grid.mm(vector, sample)
    return PatchGrid(first, size, centre_mm, depth, angle, pitch, spacing, inside, region, step)
