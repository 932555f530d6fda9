"""Grids of voxels around a sweep's images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.images import image_corners
from speckle3d.imaging.voxels.settings import VoxelType

_ROUND_SPACINGS = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
"""Between a power of ten and the next."""

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class VoxelGrid:
    """Grid of voxels: shape, spacing and pose.

    Parameters
    ----------
    shape : tuple of int
        Number of voxels along i, j and k.
    spacing_mm : tuple of float
        Distance between neighbouring voxel centres along i, j and k.
    world_from_grid : RigidTransform
        Its origin is the centre of voxel ``[0, 0, 0]``; mm.
    """

    shape: tuple[int, int, int]
    spacing_mm: Triple
    world_from_grid: RigidTransform

    def size_gb(self, voxel_type: str) -> float:
        """Size of the voxels alone, GB."""
        return float(np.prod(self.shape, dtype=float)) * np.dtype(voxel_type).itemsize / 1e9

    def __str__(self) -> str:
        voxels = " x ".join(str(n) for n in self.shape)
        return f"{voxels} voxels of {' x '.join(f'{step:g}' for step in self.spacing_mm)} mm"


def grid_around(
    grid: ImageGrid,
    world_from_image: RigidTransform,
    spacing_mm: float | Triple,
    world_from_axes: Rotation | None = None,
    *,
    origin_mm: npt.ArrayLike | None = None,
    shape: tuple[int, int, int] | None = None,
    size_mm: Triple | None = None,
) -> VoxelGrid:
    """Grid with the spacing, orientation, origin and size asked for; those not given hold the images.

    Parameters
    ----------
    grid : ImageGrid
    world_from_image : RigidTransform, length n
    spacing_mm : float, or tuple of float
        The same along i, j and k, or one for each.
    world_from_axes : Rotation, optional
        Directions of the voxel axes; without it, the world's.
    origin_mm : array_like, shape (3,), optional
        Centre of voxel ``[0, 0, 0]`` in the world; without it, the images' least corner along the axes.
    shape : tuple of int, optional
        Voxels along i, j and k.
    size_mm : tuple of float, optional
        Instead of `shape`, sizes along i, j and k from outer side to outer side, rounded up to whole voxels.
        With neither, the grid reaches to the images' greatest corner.

    Raises
    ------
    InvalidInputError
        If a value is not what it must be, there are no poses, both `shape` and `size_mm` are given, or the
        grid would end before its origin.
    """
    i, j, k = _three([spacing_mm] * 3 if np.ndim(spacing_mm) == 0 else spacing_mm, "spacing_mm")
    spacing, axes = (i, j, k), world_from_axes or Rotation.identity()
    along = axes.inv().apply(image_corners(grid, world_from_image).reshape(-1, 3))
    low, high = along.min(axis=0), along.max(axis=0)
    if origin_mm is not None:
        low = axes.inv().apply(_three(origin_mm, "origin_mm", -np.inf))
    if shape is not None and size_mm is not None:
        raise InvalidInputError("voxels: expected a shape or a size in mm, got both")
    if shape is not None:
        counts = np.array(_three(shape, "shape"))
    elif size_mm is not None:
        # A hair less, so that rounding does not add a voxel to a whole number of them.
        counts = np.ceil(np.divide(_three(size_mm, "size_mm"), spacing) - 1e-6)
    else:
        # A corner half a voxel past the last centre rounds up, and so does one a rounding error short of it.
        counts = np.floor((high - low) / spacing + 0.5 + 1e-6) + 1
    if (counts < 1).any():
        raise InvalidInputError("origin_mm: expected an origin before the images' end, got one beyond it")
    n_i, n_j, n_k = counts.astype(int).tolist()
    origin = axes.apply(low) if origin_mm is None else np.asarray(origin_mm, dtype=float)
    return VoxelGrid((n_i, n_j, n_k), spacing, RigidTransform.from_components(origin, axes))


def spacing_within(
    grid: ImageGrid,
    world_from_image: RigidTransform,
    within_gb: float,
    world_from_axes: Rotation | None = None,
    voxel_type: VoxelType = "uint8",
    origin_mm: npt.ArrayLike | None = None,
    size_mm: Triple | None = None,
) -> float:
    """Finest round spacing of cubic voxels with which a grid around images stays within a size.

    Spacings are 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6 and 8 times a power of ten. None is finer than the images'
    own samples: finer voxels would show no more.

    Parameters
    ----------
    grid, world_from_image, world_from_axes, origin_mm, size_mm
        As of `grid_around`.
    within_gb : float
        Of the voxels: what a file, unpacked, and a viewer hold.
    voxel_type : {"uint8", "int16", "uint16", "float32"}

    Returns
    -------
    float
        mm.

    Raises
    ------
    InvalidInputError
        If `within_gb` is not enough for any spacing up to 800 mm, or there are no poses.

    Examples
    --------
    >>> spacing_within(ImageGrid(400, 400, 0.1, 0.1), RigidTransform.identity(1), within_gb=1e-4)
    0.15
    """
    finest = min(grid.vector_pitch_mm, grid.sample_spacing_mm) * (1 - 1e-9)
    # As decimal text, so that 0.3 is 0.3 and not 3 x 0.1.
    for spacing in (float(f"{step}e{power}") for power in range(-6, 3) for step in _ROUND_SPACINGS):
        if spacing >= finest:
            place = grid, world_from_image, spacing, world_from_axes
            if grid_around(*place, origin_mm=origin_mm, size_mm=size_mm).size_gb(voxel_type) <= within_gb:
                return spacing
    raise InvalidInputError(f"within_gb: expected enough for some voxels, got {within_gb:g} GB")


def _three(values: npt.ArrayLike, name: str, above: float = 0.0) -> list[float]:
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (3,) or not (np.isfinite(numbers) & (numbers > above)).all():
        raise InvalidInputError(f"{name}: expected three values above {above:g}, got {numbers.tolist()}")
    return [float(number) for number in numbers]
