"""The grid of patches on an image: equal in millimetres, whatever the image's width."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.sweep import ImageGrid


class PatchSettings(BaseModel):
    """Size of the patches whose speckle is correlated.

    Fixed in millimetres: decorrelation curves belong to a patch size, not to an image width.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    width_mm: float = Field(3.6, gt=0, description="Lateral side of a patch.")
    height_mm: float = Field(3.0, gt=0, description="Axial side of a patch.")
    top_mm: float = Field(2.0, ge=0, description="Depth above which nothing is used: the near field.")


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
    spacing_mm : ndarray, shape (2,)
        Vector pitch and sample spacing.
    """

    first: IntArray
    size: IntArray
    centre_mm: FloatArray
    spacing_mm: FloatArray

    def __len__(self) -> int:
        return int(self.first.shape[0])


def lay_patches(grid: ImageGrid, settings: PatchSettings | None = None) -> PatchGrid:
    """Tile the image with as many whole patches as fit, centred laterally.

    Raises
    ------
    InvalidInputError
        If not one column or not two rows of patches fit.
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
    first = np.stack([v.ravel(), d.ravel()], axis=1).astype(np.int64)
    centre = (first + (size - 1) / 2) * spacing + [0.0, grid.first_sample_depth_mm]
    return PatchGrid(first=first, size=size, centre_mm=centre, spacing_mm=spacing)
