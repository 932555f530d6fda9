"""Planes to cut along: of a frame, along the sweep at a lateral position or at a depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.axes import line_along

MAX_PIXELS = 100_000_000
"""Largest reslice, to catch wrong units: 100 mm x 100 mm at 0.01 mm."""

_LEAST_ACROSS = 1e-3
"""Sine of the angle between the travel and the line to show that spans a plane."""


@dataclass(frozen=True)
class Cut:
    """Straight columns of square pixels side by side in the world: a plane, or a curved sheet laid flat.

    Attributes
    ----------
    base_mm : ndarray, shape (columns, 3)
        Centre of every column's first pixel, in the world; neighbours are one pixel apart.
    down : ndarray, shape (3,)
        Unit vector along which columns run.
    height_mm, pixel_mm : float
        Distance between the centres of the first and the last pixel of a column, to the nearest whole pixel,
        and of neighbours.
    first_mm : tuple of float
        What the axes of a picture say at the centre of the first pixel: x and y.
    world_from_picture : RigidTransform, optional
        Of a plane: from what the axes say, x, y and 0, mm.
    """

    base_mm: FloatArray
    down: FloatArray
    height_mm: float
    pixel_mm: float
    first_mm: tuple[float, float]
    world_from_picture: RigidTransform | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of the resliced image."""
        return round(self.height_mm / self.pixel_mm) + 1, len(self.base_mm)

    @property
    def extent_mm(self) -> tuple[float, float, float, float]:
        """Coordinates of the outer borders of the pixels: left, right, bottom and top."""
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

    def moved(self, move: RigidTransform) -> Cut:
        """The cut moved by a rigid transform."""
        plane = self.world_from_picture
        return replace(
            self,
            base_mm=move.apply(self.base_mm),
            down=move.rotation.apply(self.down),
            world_from_picture=None if plane is None else move * plane,
        )


def plane_cut(
    world_from_picture: RigidTransform, low: npt.ArrayLike, high: npt.ArrayLike, pixel_mm: float
) -> Cut:
    """Cut a plane, its x and y, from one point of its axes to another, mm.

    Raises
    ------
    InvalidInputError
        If a size is not positive and finite, or there are more than `MAX_PIXELS` pixels.
    """
    left, top = np.asarray(low, dtype=float).tolist()
    width, height = np.maximum(np.subtract(high, low), pixel_mm).tolist()
    require_pixels(width, height, pixel_mm)
    columns = left + np.arange(round(width / pixel_mm) + 1) * pixel_mm
    base = world_from_picture.apply(np.insert(np.outer(columns, [1.0, 0.0]), 1, top, axis=1))
    down = world_from_picture.rotation.apply([0.0, 1.0, 0.0])
    return Cut(base, down, height, pixel_mm, (left, top), world_from_picture)


def require_pixels(width_mm: float, height_mm: float, pixel_mm: float) -> None:
    """Raise `InvalidInputError` unless sizes are positive and there are at most `MAX_PIXELS` pixels."""
    sizes = width_mm, height_mm, pixel_mm
    if not 0 < min(sizes) <= max(sizes) < np.inf:
        raise InvalidInputError(f"pixel_mm: expected width, height and pixels above zero, got {sizes} mm")
    if (width_mm / pixel_mm + 1) * (height_mm / pixel_mm + 1) > MAX_PIXELS:
        raise InvalidInputError(
            f"reslice of {width_mm:g} x {height_mm:g} mm: expected at most {MAX_PIXELS} pixels, got "
            f"more with pixels of {pixel_mm:g} mm"
        )


def image_plane(world_from_image: RigidTransform, grid: ImageGrid, pixel_mm: float) -> Cut:
    """Plane of one image, of the image's size."""
    low, high = grid.extent_mm
    return plane_cut(world_from_image, low, high, pixel_mm)


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
    pixel_mm: float,
    largest_mm: tuple[float, float] = (np.inf, np.inf),
) -> dict[str, Cut]:
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
    return {mode: plane_cut(axes, low, high, pixel_mm) for mode, (axes, _) in planes.items()}


def _plane_of_travel(
    world_from_image: RigidTransform, line_mm: FloatArray
) -> tuple[RigidTransform, FloatArray]:
    """Place a plane in the first frame's line and the mean travel; also where on it all lines' ends are.

    Its y is the first frame's line, with depth counted from the probe, lateral from the first vector.

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
    begin = line_mm[0] @ (line_mm[1] != line_mm[0])
    world_from_plane = RigidTransform.from_components(ends[0, 0] - begin * down, axes)
    return world_from_plane, world_from_plane.inv().apply(ends.reshape(-1, 3))[:, :2]
