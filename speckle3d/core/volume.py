"""A volume: voxels on a regular grid, with the grid's pose in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.shown import shown

VOXEL_TYPES = ("uint8", "int16", "uint16", "float32")
"""Types that voxels may have."""


@shown
@dataclass(frozen=True)
class Volume:
    """Voxels indexed ``[i, j, k]`` along the grid's own x, y and z axes.

    Parameters
    ----------
    voxels : ndarray of a type in `VOXEL_TYPES`, shape (n_i, n_j, n_k)
        In any order in memory; files have the first axis run fastest.
    spacing_mm : tuple of float
        Distance between neighbouring voxel centres along i, j and k.
    world_from_grid : RigidTransform
        Pose of the grid, mm; its origin is the centre of voxel ``[0, 0, 0]``.
    fields : mapping of str to str
        What files say of the voxels beside where they lie: what their levels are, how they were made.

    Examples
    --------
    >>> volume = Volume(np.zeros((4, 3, 2), np.uint8), (0.5, 0.5, 1.0), RigidTransform.identity())
    >>> (volume.world_from_index @ [3, 2, 1, 1]).tolist()
    [1.5, 1.0, 1.0, 1.0]
    """

    voxels: npt.NDArray[Any]
    spacing_mm: tuple[float, float, float]
    world_from_grid: RigidTransform
    fields: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        if self.voxels.ndim != 3 or not self.voxels.size or self.voxels.dtype.name not in VOXEL_TYPES:
            raise InvalidInputError(
                f"voxels: expected shape (n_i, n_j, n_k) of {', '.join(VOXEL_TYPES)}, got "
                f"{self.voxels.shape} of {self.voxels.dtype}"
            )
        spacing_mm = tuple(map(float, self.spacing_mm))
        if len(spacing_mm) != 3 or not all(0 < step < np.inf for step in spacing_mm):
            raise InvalidInputError(f"spacing_mm: expected three values above zero, got {self.spacing_mm}")
        object.__setattr__(self, "spacing_mm", spacing_mm)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along i, j and k."""
        n_i, n_j, n_k = self.voxels.shape
        return n_i, n_j, n_k

    def to_napari(self, viewer: Any = None) -> tuple[Any, dict[str, Any], str]:
        """Voxels as layer data of napari, added to a viewer if one is given (extra ``napari``)."""
        place = {"name": "speckle3d", "affine": self.world_from_index, "units": ("mm", "mm", "mm")}
        if viewer is not None:
            viewer.add_image(self.voxels, **place)
        return self.voxels, place, "image"

    @property
    def world_from_index(self) -> FloatArray:
        """Affine matrix from voxel indices to world mm, shape (4, 4)."""
        scale = np.diag([*self.spacing_mm, 1.0])
        return np.asarray(self.world_from_grid.as_matrix() @ scale)
