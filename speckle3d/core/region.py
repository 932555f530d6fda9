"""Parts of the images that count: rectangles, fans and polygons, and what several have in common.

Positions are millimetres in the image: x lateral from the first vector, y axial, the depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module
from speckle3d.core.geometry import require_finite
from speckle3d.core.grid import ImageGrid

REGION_HELP = "'rectangle x0,y0 x1,y1', 'fan x,y angle,angle radius,radius' or 'polygon x,y x,y x,y ...'"
"""How a region is written: mm in the image, degrees from straight down, several joined by ' and '."""

_HAIR = 1e-6
"""Fraction of a pixel by which a sample may miss a side and count: rounding of sizes in mm."""

Pair = tuple[float, float]


@dataclass(frozen=True)
class Region:
    """The part of the image that all of some shapes cover, their sides included.

    Parameters
    ----------
    text : str
        Shapes joined by ' and ': see `REGION_HELP`. A fan is what a curved or a phased array sees: apex, two
        angles of -90 to 90 degrees from straight down towards growing x, two distances from the apex.

    Raises
    ------
    InvalidInputError
        If the text is no region.

    Examples
    --------
    >>> region = Region("rectangle 0,1 2,3 and polygon 0,0 4,0 0,4")
    >>> region.mask(ImageGrid(4, 5, 1.0, 1.0)).astype(int).tolist()
    [[0, 1, 1, 1, 0], [0, 1, 1, 1, 0], [0, 1, 1, 0, 0], [0, 0, 0, 0, 0]]
    """

    text: str

    def __post_init__(self) -> None:
        self._inside(ImageGrid(1, 1, 1.0, 1.0))

    def mask(self, grid: ImageGrid) -> BoolArray:
        """Which samples count, shape (vector, sample).

        Raises
        ------
        InvalidInputError
            If none does.
        """
        inside = self._inside(grid)
        if not inside.any():
            (left, top), (right, bottom) = grid.extent_mm
            raise InvalidInputError(
                f"region: expected samples of the image inside, which is x {left:g} to {right:g} mm and y "
                f"{top:g} to {bottom:g} mm, got none"
            )
        return inside

    def part(self, grid: ImageGrid) -> ImageGrid:
        """Smallest rectangle of an image of parallel vectors that holds the region.

        A grid of voxels around it has no room for what does not count.

        Raises
        ------
        InvalidInputError
            If no sample counts.
        """
        inside = self.mask(grid)
        vector, sample = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        wide, high = int(np.ptp(vector)) + 1, int(np.ptp(sample)) + 1
        left, top = grid.mm(vector[0], sample[0]).tolist()
        return replace(grid, vectors=wide, samples=high, first_vector_mm=left, first_sample_depth_mm=top)

    def _inside(self, grid: ImageGrid) -> BoolArray:
        pixel = np.array([grid.vector_pitch_mm, grid.sample_spacing_mm])
        places = grid.mm(np.arange(grid.vectors)[:, None], np.arange(grid.samples))
        inside = np.ones(places.shape[:2], dtype=bool)
        for part in self.text.split(" and "):
            kind, *words = part.split() or [""]
            try:
                corners = [(float(x), float(y)) for x, y in (word.split(",") for word in words)]
                inside &= _SHAPES[kind](places, pixel, *corners)
            except InvalidInputError:
                raise
            except (KeyError, TypeError, ValueError):
                raise InvalidInputError(
                    f"region: expected {REGION_HELP}, joined by ' and ', got {self.text!r}"
                ) from None
        return inside


def polygon_mask(places: FloatArray, corners: npt.ArrayLike, name: str = "polygon") -> BoolArray:
    """Which places are in a polygon, its sides included.

    Parameters
    ----------
    places : ndarray, shape (n, m, 2)
        In pixels, whose millionth part is rounding.
    corners : array_like, shape (k, 2)
        Three or more corners of any simple polygon, in the same unit.
    name : str
        Of the corners, for the errors.

    Returns
    -------
    ndarray of bool, shape (n, m)

    Raises
    ------
    InvalidInputError
        If corners are too few, or not all finite.
    """
    outline = np.asarray(corners, dtype=float)
    if outline.ndim != 2 or outline.shape[0] < 3 or outline.shape[1] != 2:
        raise InvalidInputError(f"{name}: expected shape (k, 2) with k of 3 or more, got {outline.shape}")
    require_finite(outline, name)
    measure = extra_module("skimage.measure", "calibrate", "a region")
    inside = measure.points_in_poly(np.round(places.reshape(-1, 2), 6), np.round(outline, 6))
    return np.asarray(inside.reshape(places.shape[:2]))


def _rectangle(places: FloatArray, pixel: FloatArray, low: Pair, high: Pair) -> BoolArray:
    if not np.less(low, high).all():
        raise ValueError
    hair = _HAIR * pixel
    return np.asarray(((places >= low - hair) & (places <= high + hair)).all(axis=-1))


def _fan(places: FloatArray, pixel: FloatArray, apex: Pair, angles_deg: Pair, radii: Pair) -> BoolArray:
    (left, right), (near, far) = angles_deg, radii
    if not (-90 <= left < right <= 90 and 0 <= near < far):
        raise ValueError
    x, y = np.moveaxis(places - apex, -1, 0)
    radius, angle, hair = np.hypot(x, y), np.arctan2(x, y), _HAIR * pixel.min()
    # Distances along the arc from the two sides, positive inside.
    between = radius * np.minimum(angle - np.radians(left), np.radians(right) - angle) >= -hair
    return np.asarray(between & (radius >= near - hair) & (radius <= far + hair))


def _polygon(places: FloatArray, pixel: FloatArray, *corners: Pair) -> BoolArray:
    return polygon_mask(places / pixel, np.reshape(corners, (-1, 2)) / pixel)


_SHAPES: dict[str, Callable[..., BoolArray]] = {"rectangle": _rectangle, "fan": _fan, "polygon": _polygon}
