"""Volumes whose voxels are labels, and what the labels mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.shown import shown
from speckle3d.core.volume import Volume

LABEL_TYPES = ("uint8", "uint16")
"""Types that labels may have; 0 is the background, which has no segment."""


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
        fair = len(self.colour) == 3 and all(0 <= part <= 1 for part in self.colour)
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
        if self.voxels.dtype.name not in LABEL_TYPES:
            raise InvalidInputError(f"labels: expected {' or '.join(LABEL_TYPES)}, got {self.voxels.dtype}")
        labels, most = [segment.value for segment in self.segments], np.iinfo(self.voxels.dtype).max
        if len({*labels}) != len(labels) or max(labels, default=0) > most:
            raise InvalidInputError(f"segments: expected one for each label up to {most}, got {labels}")
