"""Parts of the images that count: rectangles, fans and polygons, and what several have in common.

Positions are millimetres in the image: x lateral from the first vector, y axial, the depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.polygons import polygon_corners, polygon_mask
from speckle3d.core.sweep import ImageGrid

REGION_HELP = "'rectangle x0,y0 x1,y1', 'fan x,y angle,angle radius,radius' or 'polygon x,y x,y x,y ...'"
"""How a region is written: mm in the image, degrees from straight down, several joined by ' and '."""

_HAIR = 1e-6
"""Fraction of a pixel by which a sample may miss a side and count: rounding of sizes in mm."""

Pair = tuple[float, float]


@dataclass(frozen=True)
class Rectangle:
    """A rectangle with sides along the image's.

    Parameters
    ----------
    low_mm, high_mm : tuple of float
        Its least and its largest x and y.
    """

    low_mm: Pair
    high_mm: Pair

    def __post_init__(self) -> None:
        if not (np.isfinite([self.low_mm, self.high_mm]).all() and np.less(self.low_mm, self.high_mm).all()):
            raise InvalidInputError(
                f"rectangle: expected two finite corners, the lower values first, got {self.low_mm} and "
                f"{self.high_mm} mm"
            )

    def mask(self, grid: ImageGrid) -> BoolArray:
        """Which samples are inside or on a side, shape (vector, sample)."""
        position, hair = np.stack(_positions_mm(grid), axis=-1), _hair_mm(grid)
        low, high = np.array(self.low_mm) - hair, np.array(self.high_mm) + hair
        return np.asarray(((position >= low) & (position <= high)).all(axis=-1))


@dataclass(frozen=True)
class Fan:
    """What a curved or a phased array sees: between two angles and two radii about an apex.

    Parameters
    ----------
    apex_mm : tuple of float
        x and y of the point where the lines of sight meet; often above the image.
    angles_deg : tuple of float
        The two sides, from straight down (along y) and towards growing x; within 90 degrees.
    radii_mm : tuple of float
        Distances from the apex, the nearer first.
    """

    apex_mm: Pair
    angles_deg: Pair
    radii_mm: Pair

    def __post_init__(self) -> None:
        (left, right), (near, far) = self.angles_deg, self.radii_mm
        if not (np.isfinite(self.apex_mm).all() and -90 <= left < right <= 90 and 0 <= near < far < np.inf):
            raise InvalidInputError(
                "fan: expected a finite apex, two angles of -90 to 90 degrees and two radii of zero or more, "
                f"the smaller first, got {self.apex_mm} {self.angles_deg} {self.radii_mm}"
            )

    def mask(self, grid: ImageGrid) -> BoolArray:
        """Which samples are inside or on a side, shape (vector, sample)."""
        x, y = (position - apex for position, apex in zip(_positions_mm(grid), self.apex_mm, strict=True))
        hair = _hair_mm(grid)
        radius = np.hypot(x, y)
        between = (radius >= self.radii_mm[0] - hair) & (radius <= self.radii_mm[1] + hair)
        left, right = np.radians(self.angles_deg)
        # Distances from the two sides, positive inside; each is right for all angles up to 90 degrees.
        past_left = x * np.cos(left) - y * np.sin(left) >= -hair
        before_right = y * np.sin(right) - x * np.cos(right) >= -hair
        return np.asarray(between & past_left & before_right & (y >= -hair))


@dataclass(frozen=True)
class Polygon:
    """Any simple polygon.

    Parameters
    ----------
    corners_mm : tuple of tuple of float
        x and y of three corners or more, in order.
    """

    corners_mm: tuple[Pair, ...]

    def __post_init__(self) -> None:
        polygon_corners(self.corners_mm, "polygon")

    def mask(self, grid: ImageGrid) -> BoolArray:
        """Which samples are inside or on a side, shape (vector, sample)."""
        image_from_sample = grid.image_from_sample[:2]
        corners = np.linalg.solve(image_from_sample[:, :2], (self.corners_mm - image_from_sample[:, 2]).T).T
        # Rounded, so that a sample on a side counts whatever the size of a pixel.
        return polygon_mask((grid.vectors, grid.samples), np.round(corners, 6))


Shape = Rectangle | Fan | Polygon


@dataclass(frozen=True)
class Region:
    """The part of the image that all of some shapes cover.

    Parameters
    ----------
    shapes : tuple of Rectangle, Fan or Polygon
        Without any, the region is the whole image.

    Examples
    --------
    >>> region = Region.from_text("rectangle 0,1 2,3") & Region((Polygon(((0, 0), (4, 0), (0, 4))),))
    >>> region.mask(ImageGrid(4, 5, 1.0, 1.0)).astype(int).tolist()
    [[0, 1, 1, 1, 0], [0, 1, 1, 1, 0], [0, 1, 1, 0, 0], [0, 0, 0, 0, 0]]
    """

    shapes: tuple[Shape, ...] = ()

    def __and__(self, other: Region) -> Region:
        """What both cover."""
        return Region((*self.shapes, *other.shapes))

    @classmethod
    def from_text(cls, text: str) -> Region:
        """Region as written on the command line: shapes (see `REGION_HELP`) joined by ' and '.

        Raises
        ------
        InvalidInputError
            If the text is no region.
        """
        return cls(tuple(_shape(part, text) for part in text.split(" and ")))

    def mask(self, grid: ImageGrid) -> BoolArray:
        """Which samples count, shape (vector, sample).

        Raises
        ------
        InvalidInputError
            If none does.
        """
        inside = np.ones((grid.vectors, grid.samples), dtype=bool)
        for shape in self.shapes:
            inside &= shape.mask(grid)
        if not inside.any():
            raise InvalidInputError(
                "region: expected samples of the image inside, which is x 0 to "
                f"{grid.width_mm:g} mm and y {grid.first_sample_depth_mm:g} to {grid.depth_mm:g} mm, got none"
            )
        return inside

    def part(self, grid: ImageGrid, world_from_image: RigidTransform) -> tuple[ImageGrid, RigidTransform]:
        """Smallest rectangles of the images that hold the region: their grid, and the poses of each.

        A grid of voxels around them has no room for what does not count.

        Raises
        ------
        InvalidInputError
            If no sample counts.
        """
        inside = self.mask(grid)
        vector, sample = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        moved_mm = grid.image_from_sample[:3, :2] @ [vector[0], sample[0]]
        sides = int(vector[-1] - vector[0] + 1), int(sample[-1] - sample[0] + 1)
        within = replace(grid, vectors=sides[0], samples=sides[1])
        return within, world_from_image * RigidTransform.from_translation(moved_mm)


def _positions_mm(grid: ImageGrid) -> tuple[FloatArray, FloatArray]:
    """Where the samples lie: x and y, each of shape (vector, sample)."""
    sample = np.arange(float(grid.samples))
    x, y = (
        along * np.arange(float(grid.vectors))[:, None] + (down * sample + first)
        for along, down, first in grid.image_from_sample[:2].tolist()
    )
    return x, y


def _hair_mm(grid: ImageGrid) -> float:
    return _HAIR * min(grid.vector_pitch_mm, grid.sample_spacing_mm)


def _shape(part: str, text: str) -> Shape:
    kind, *words = part.split() or [""]
    try:
        return _MAKERS[kind](*map(_pair, words))
    except InvalidInputError:
        raise
    except (KeyError, TypeError, ValueError):
        raise InvalidInputError(f"region: expected {REGION_HELP}, joined by ' and ', got {text!r}") from None


_MAKERS: dict[str, Callable[..., Shape]] = {
    "rectangle": Rectangle,
    "fan": Fan,
    "polygon": lambda *corners: Polygon(corners),
}


def _pair(word: str) -> Pair:
    first, second = word.split(",")
    return float(first), float(second)
