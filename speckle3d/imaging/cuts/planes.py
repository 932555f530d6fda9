"""Planes to cut along: of a frame, along the sweep at a lateral position or at a depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.axes import line_along

MAX_PIXELS = 100_000_000
"""Largest reslice, to catch wrong units: 100 mm x 100 mm at 0.01 mm."""

DEFAULT_PIXEL_MM = 0.2
"""Between the axial and the lateral resolution of a 5-10 MHz probe."""

_LEAST_ACROSS = 1e-3
"""Sine of the angle between the travel and the line to show that spans a plane."""


class Cut:
    """Straight columns of square pixels side by side in the world: a plane, or a sheet that is laid flat.

    Attributes
    ----------
    base_mm : ndarray, shape (columns, 3)
        Centre of every column's first pixel, in the world.
    down : ndarray, shape (3,)
        Unit vector along which columns run.
    height_mm, pixel_mm : float
        Distance between the centres of the first and the last pixel of a column, to the nearest whole pixel,
        and of neighbours.
    first_mm : tuple of float
        What the axes of a picture say at the centre of the first pixel: x and y.
    """

    height_mm: float
    pixel_mm: float
    first_mm: tuple[float, float]

    if TYPE_CHECKING:

        @property
        def base_mm(self) -> FloatArray:
            """Of the first pixels."""

        @property
        def down(self) -> FloatArray:
            """Along the columns."""

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of the resliced image."""
        return round(self.height_mm / self.pixel_mm) + 1, len(self.base_mm)

    @property
    def extent_mm(self) -> tuple[float, float, float, float]:
        """What the axes say at the outer borders of the pixels: left, right, bottom and top."""
        rows, columns = self.shape
        left, top = (first - self.pixel_mm / 2 for first in self.first_mm)
        return left, left + columns * self.pixel_mm, top + rows * self.pixel_mm, top

    def lines(self) -> FloatArray:
        """Of each column the first pixel's centre and the step to the next, shape (columns, 2, 3), mm."""
        step = np.broadcast_to(self.down * self.pixel_mm, self.base_mm.shape)
        return np.stack([self.base_mm, step], axis=1)

    @property
    def hull_mm(self) -> FloatArray:
        """First pixels of all columns, then last ones, shape (2 columns, 3), mm in the world."""
        below = (self.shape[0] - 1) * self.pixel_mm * self.down
        return np.concatenate([self.base_mm, self.base_mm + below])


@dataclass(frozen=True)
class ReslicePlane(Cut):
    """A rectangle in the world and the pixels it is cut into.

    Parameters
    ----------
    world_from_plane : RigidTransform, single
        The plane's origin is the centre of its first pixel, x runs along a row (columns grow), y down a
        column (rows grow), z is the normal. Translation in mm.
    width_mm, height_mm : float
        Distance between the centres of the first and the last pixel of a row and of a column, to the
        nearest whole pixel.
    pixel_mm : float
        Spacing of the square pixels.
    first_mm : tuple of float
        What the axes of a picture say at the centre of the first pixel: x and y.

    Raises
    ------
    InvalidInputError
        If a size is not positive and finite, or the plane has more than `MAX_PIXELS` pixels.
    """

    world_from_plane: RigidTransform
    width_mm: float
    height_mm: float
    pixel_mm: float
    first_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        require_pixels(self.width_mm, self.height_mm, self.pixel_mm)

    @cached_property
    def base_mm(self) -> FloatArray:
        """Centre of every column's first pixel."""
        columns = np.arange(round(self.width_mm / self.pixel_mm) + 1)
        return self.world_from_plane.apply(np.outer(columns * self.pixel_mm, [1.0, 0.0, 0.0]))

    @cached_property
    def down(self) -> FloatArray:
        """Unit vector along the columns."""
        return self.world_from_plane.rotation.apply([0.0, 1.0, 0.0])

    def world_from_mm(self, x_mm: npt.ArrayLike, y_mm: npt.ArrayLike) -> FloatArray:
        """Points of the world by what the picture's axes say, shape (..., 3), mm."""
        x, y = np.broadcast_arrays(np.asarray(x_mm, dtype=float), np.asarray(y_mm, dtype=float))
        inside = np.stack([x - self.first_mm[0], y - self.first_mm[1], np.zeros_like(x)], axis=-1)
        return self.world_from_plane.apply(inside.reshape(-1, 3)).reshape(inside.shape)


def require_pixels(width_mm: float, height_mm: float, pixel_mm: float) -> None:
    """Raise `InvalidInputError` unless sizes are positive and there are at most `MAX_PIXELS` pixels."""
    sizes = width_mm, height_mm, pixel_mm
    if not 0 < min(sizes) <= max(sizes) < np.inf:
        raise InvalidInputError(f"width, height and pixel: expected values above zero, got {sizes} mm")
    if (width_mm / pixel_mm + 1) * (height_mm / pixel_mm + 1) > MAX_PIXELS:
        raise InvalidInputError(
            f"reslice of {width_mm:g} x {height_mm:g} mm: expected at most {MAX_PIXELS} pixels, got "
            f"more with pixels of {pixel_mm:g} mm"
        )


def image_plane(world_from_image: RigidTransform, grid: ImageGrid, pixel_mm: float) -> ReslicePlane:
    """The plane of one image, as large as the image: what another sweep shows there."""
    first, (width, height) = grid.extent_mm[0].tolist(), np.ptp(grid.extent_mm, axis=0).tolist()
    corner = RigidTransform.from_translation([*first, 0.0])
    return ReslicePlane(world_from_image * corner, width, height, pixel_mm, (first[0], first[1]))


def lateral_line(grid: ImageGrid, lateral_mm: float) -> FloatArray:
    """Line of an image down its depth at one lateral position, shape (2, 3), mm."""
    return _line(grid, 0, "lateral_mm", lateral_mm)


def depth_line(grid: ImageGrid, depth_mm: float) -> FloatArray:
    """Line of an image across its width at one depth, shape (2, 3), mm."""
    return _line(grid, 1, "depth_mm", depth_mm)


def _line(grid: ImageGrid, axis: int, name: str, value: float) -> FloatArray:
    ends = np.column_stack([grid.extent_mm, np.zeros(2)])
    low, high = ends[:, axis]
    if not low <= value <= high:
        raise InvalidInputError(
            f"{name}: expected a value inside the image, {low:g} to {high:g}, got {value:g}"
        )
    ends[:, axis] = value
    return ends


def planes_from_first_frame(
    poses: Mapping[str, RigidTransform],
    line_mm: FloatArray,
    pixel_mm: float = DEFAULT_PIXEL_MM,
    largest_mm: tuple[float, float] = (np.inf, np.inf),
) -> dict[str, ReslicePlane]:
    """Planes along one sweep at different poses, one size, with the first frame's line in one place of all.

    What differs between such pictures is where the sweep went after its first frame.

    Parameters
    ----------
    poses : mapping of str to RigidTransform, length n
        World from image by mode, each in a world of its own.
    line_mm : ndarray, shape (2, 3)
        Line of every image that the plane is to cover, in the image: `lateral_line` or `depth_line`.
    pixel_mm : float
    largest_mm : tuple of float
        Width and height at most; what lies farthest from the first frame is left out.

    Raises
    ------
    InsufficientDataError
        If the sweep moves along the line.
    """
    planes = {mode: _plane_of_travel(path, line_mm) for mode, path in poses.items()}
    ends = np.concatenate([points for _, points in planes.values()])
    low = np.maximum(ends.min(axis=0), np.negative(largest_mm))
    high = np.min([ends.max(axis=0), largest_mm, low + largest_mm], axis=0)
    # Depth counts from the probe, lateral from the first vector.
    begin = line_mm[0] @ (line_mm[1] != line_mm[0])
    return {mode: plane_part(axes, low, high, pixel_mm, begin) for mode, (axes, _) in planes.items()}


def plane_part(
    world_from_plane: RigidTransform,
    low: FloatArray,
    high: FloatArray,
    pixel_mm: float,
    begin_mm: float = 0.0,
) -> ReslicePlane:
    """Rectangle of a plane; its axes count from the plane's origin, y with `begin_mm` there."""
    start = RigidTransform.from_translation([*low, 0.0])
    width, height = np.maximum(high - low, pixel_mm).tolist()
    first_mm = (float(low[0]), float(low[1] + begin_mm))
    return ReslicePlane(world_from_plane * start, width, height, pixel_mm, first_mm)


def _plane_of_travel(
    world_from_image: RigidTransform, line_mm: FloatArray
) -> tuple[RigidTransform, FloatArray]:
    """Place a plane in the first frame's line and the mean travel; also where on it all lines' ends are.

    Its origin is where the first frame's line begins, and its y is that line.

    Returns
    -------
    (RigidTransform, ndarray, shape (2 n, 2))
    """
    ends = np.stack([world_from_image.apply(point) for point in line_mm])
    # A micrometre is no travel to take a direction from.
    forward = 1e-3 * world_from_image[:1].rotation.apply([0.0, 0.0, 1.0])
    travel = line_along(np.concatenate([forward, ends.mean(axis=0) - ends.mean(axis=(0, 1))]))
    down = (ends[1, 0] - ends[0, 0]) / np.linalg.norm(ends[1, 0] - ends[0, 0])
    right = travel - (travel @ down) * down
    length = float(np.linalg.norm(right))
    if length < _LEAST_ACROSS:
        raise InsufficientDataError("the poses move along the line to show: expected travel across it")
    axes = Rotation.from_matrix(np.column_stack([right / length, down, np.cross(right / length, down)]))
    world_from_plane = RigidTransform.from_components(ends[0, 0], axes)
    return world_from_plane, world_from_plane.inv().apply(ends.reshape(-1, 3))[:, :2]
