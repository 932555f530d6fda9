"""Grey images of a sweep with their poses, read one at a time so that memory does not grow with the sweep."""

from __future__ import annotations

from collections.abc import Callable, Sized
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.images import any_thread


class IndexedImages(Protocol):
    """Anything indexed by frame: an array, a list, a lazy reader."""

    def __getitem__(self, index: int, /) -> npt.NDArray[Any]:
        """Read one image, shape (vector, sample)."""


Images = IndexedImages | Callable[[int], npt.NDArray[Any]]
"""Where images come from: indexed or called with the frame's number, giving shape (vector, sample)."""


@dataclass(frozen=True)
class PosedImages:
    """Images on one grid with the pose of each.

    Parameters
    ----------
    images : indexable or callable
        Grey images, shape (vector, sample), any real type; NaN marks samples without a value.
    grid : ImageGrid
    world_from_image : RigidTransform, length n
        Translation in mm.

    Raises
    ------
    MismatchError
        If the number of images is known and differs from the number of poses.
    InvalidInputError
        If there are no poses.
    """

    images: Images
    grid: ImageGrid
    world_from_image: RigidTransform

    def __post_init__(self) -> None:
        require_poses(self.world_from_image)
        count = len(self.images) if isinstance(self.images, Sized) else len(self)
        if count != len(self):
            raise MismatchError(
                f"world_from_image: expected {count} poses for {count} images, got {len(self)}"
            )

    def __len__(self) -> int:
        return len(self.world_from_image)

    def read(self, index: int) -> npt.NDArray[Any]:
        """Image number `index` in the type and the order in memory that it has, shape (vector, sample).

        Raises
        ------
        MismatchError
            If the image does not lie on the grid.
        InvalidInputError
            If it is complex.
        """
        image = _read(self.images, index)
        expected = (self.grid.vectors, self.grid.samples)
        if image.shape != expected:
            raise MismatchError(f"images[{index}]: expected shape {expected}, got {image.shape}")
        if np.iscomplexobj(image):
            raise InvalidInputError(f"images[{index}]: expected grey levels, got type {image.dtype}")
        return image

    def index_from_image(self) -> FloatArray:
        """Affine map from image coordinates (x, y, z, 1) in mm to (vector, sample, z in mm), shape (3, 4)."""
        elevational = [0.0, 0.0, 1.0, 0.0]
        return np.asarray(np.linalg.inv(np.insert(self.grid.image_from_sample, 2, elevational, axis=1))[:3])


@dataclass(frozen=True)
class ChosenImages:
    """Subset of images, counted from zero.

    Parameters
    ----------
    images : indexable or callable
    frames : ndarray of int, shape (n,)
        Which.
    """

    images: Images
    frames: IntArray

    def __getitem__(self, index: int) -> npt.NDArray[Any]:
        """Read one image, shape (vector, sample)."""
        return _read(self.images, int(self.frames[index]))

    def __len__(self) -> int:
        return int(self.frames.size)

    @property
    def any_thread(self) -> bool:
        """Whether images may be read by several threads at once."""
        return any_thread(self.images)


def _read(images: Images, index: int) -> npt.NDArray[Any]:
    return images(index) if callable(images) else images[index]


def require_poses(world_from_image: RigidTransform) -> None:
    """Raise `InvalidInputError` unless there is a row of at least one pose."""
    if world_from_image.single or len(world_from_image) == 0:
        raise InvalidInputError(
            "world_from_image: expected a row of poses, one per image, got a single one or none"
        )


def image_corners(grid: ImageGrid, world_from_image: RigidTransform) -> FloatArray:
    """Corners of all images in the world, clockwise from the top left, shape (n, 4, 3), mm."""
    require_poses(world_from_image)
    return np.stack([world_from_image.apply(corner) for corner in grid.corners_mm], axis=1)


def image_outline(grid: ImageGrid) -> FloatArray:
    """Closed line around an image in its plane, a fan's along its arcs, shape (m, 3), mm."""
    last, deepest = grid.vectors - 1, grid.samples - 1
    across = np.array([0, last]) if grid.fan is None else np.arange(last + 1)
    line = np.concatenate([grid.mm(across, 0), grid.mm(across[::-1], deepest), grid.mm([0], [0])])
    return np.pad(line, ((0, 0), (0, 1)))
