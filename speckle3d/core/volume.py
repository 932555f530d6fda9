"""Volumes of grey levels or labels: voxels on a regular grid, with the grid's pose in the world."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import AnyArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.text import shown

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

    voxels: AnyArray
    spacing_mm: tuple[float, float, float]
    world_from_grid: RigidTransform
    fields: Mapping[str, str] = field(default_factory=dict)

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

    @property
    def world_from_index(self) -> FloatArray:
        """Affine matrix from voxel indices to world mm, shape (4, 4)."""
        return self.world_from_grid.as_matrix() * [*self.spacing_mm, 1.0]


@dataclass(frozen=True)
class Segment:
    """Name and colour of one label.

    Parameters
    ----------
    value : int
        The label, above zero.
    name : str
        What a person reads.
    colour : tuple of float
        Red, green and blue, 0 to 1.

    Raises
    ------
    InvalidInputError
        Naming the argument that is not what it must be.
    """

    value: int
    name: str
    colour: tuple[float, float, float]

    def __post_init__(self) -> None:
        fair = len(self.colour) == 3 == sum(0 <= part <= 1 for part in self.colour)
        if not (0 < self.value < 2**16 and self.name.strip() and fair):
            raise InvalidInputError(
                f"segment: expected a label from 1 to 65535, a name and a colour of three parts, got {self}"
            )


EMPTY, MEASURED, FILLED = 0, 1, 2
"""States of a voxel: without a value, with samples of its own, and with a value that comes from others."""

STATE_SEGMENTS = (
    Segment(MEASURED, "measured", (0.25, 0.75, 0.35)),
    Segment(FILLED, "filled", (0.95, 0.65, 0.15)),
)
"""Of voxels by how they came to their value."""


@shown
@dataclass(frozen=True)
class LabelMap(Volume):
    """Labels on a regular grid, uint8 or uint16.

    Parameters
    ----------
    segments : tuple of Segment
        What labels mean; one that has no segment means nothing.
    voxels : ndarray of uint8 or uint16, shape (n_i, n_j, n_k)
        Label of each voxel.
    spacing_mm, world_from_grid, fields
        As of a `Volume`.

    Raises
    ------
    InvalidInputError
        If voxels are of another type, or two segments have one label.

    Examples
    --------
    >>> from scipy.spatial.transform import RigidTransform
    >>> state = np.zeros((4, 3, 2), np.uint8)
    >>> labels = LabelMap(state, (0.5, 0.5, 0.5), RigidTransform.identity(), {}, STATE_SEGMENTS)
    >>> [segment.name for segment in labels.segments]
    ['measured', 'filled']
    """

    segments: tuple[Segment, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.voxels.dtype.kind != "u":
            raise InvalidInputError(f"labels: expected uint8 or uint16, got {self.voxels.dtype}")
        labels, most = [segment.value for segment in self.segments], np.iinfo(self.voxels.dtype).max
        if len({*labels}) != len(labels) or max(labels, default=0) > most:
            raise InvalidInputError(f"segments: expected one for each label up to {most}, got {labels}")
