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
from speckle3d.core.grid import FanLines, ImageGrid

REGION_HELP = "'rectangle x0,y0 x1,y1', 'fan x,y angle,angle radius,radius' or 'polygon x,y x,y x,y ...'"
"""How a region is written: mm in the image, degrees from straight down, several joined by ' and '."""

Pair = tuple[float, float]
Shape = Callable[[FloatArray], BoolArray]
"""Which places, mm, shape (..., 2), are in it."""


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
        places = grid.mm(np.arange(grid.vectors)[:, None], np.arange(grid.samples))
        inside = np.ones(places.shape[:2], dtype=bool)
        for part in self.text.split(" and "):
            try:
                kind, *words = part.split()
                shape = _SHAPES[kind](*((float(x), float(y)) for x, y in (word.split(",") for word in words)))
            except (KeyError, TypeError, ValueError):
                raise InvalidInputError(
                    f"region: expected {REGION_HELP}, joined by ' and ', got {self.text!r}"
                ) from None
            inside &= shape(places)
        return inside


def polygon_mask(places: FloatArray, corners: npt.ArrayLike, name: str = "polygon") -> BoolArray:
    """Which places are in a polygon, its sides included.

    Parameters
    ----------
    places : ndarray, shape (n, m, 2)
        In pixels or mm, whose millionth part is rounding.
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


def _rectangle(low: Pair, high: Pair) -> Shape:
    width, height = high[0] - low[0], high[1] - low[1]
    return ImageGrid(2, 2, width, height, low[1], first_vector_mm=low[0]).holds


def _fan(apex: Pair, angles_deg: Pair, radii: Pair) -> Shape:
    first, last = np.radians(angles_deg).tolist()
    fan = FanLines(apex, radii[0], first, last - first)
    return ImageGrid(2, 2, 1.0, radii[1] - radii[0], fan=fan).holds


def _polygon(*corners: Pair) -> Shape:
    return lambda places: polygon_mask(places, corners)


_SHAPES: dict[str, Callable[..., Shape]] = {"rectangle": _rectangle, "fan": _fan, "polygon": _polygon}
