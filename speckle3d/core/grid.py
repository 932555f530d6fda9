"""Grid of an image's samples on parallel vectors or a fan, its scan conversion, and regions of it.

Positions are millimetres in the image: x lateral from the first vector, y axial, the depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from speckle3d.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.extras import extra_module

_ROUNDING = 1e-6
"""Of a pitch, by which a place may miss the first or the last sample and be in the image."""

_PIXELS_PER_PITCH = 4
"""Of the picture in the distance of neighbouring vectors at the middle depth: linear interpolation between
vectors then shows nothing of the pixels."""

REGION_HELP = "'rectangle x0,y0 x1,y1', 'fan x,y angle,angle radius,radius' or 'polygon x,y x,y x,y ...'"
"""How a region is written: mm in the image, degrees from straight down, several joined by ' and '."""


@dataclass(frozen=True)
class FanLines:
    """Scan lines that spread from a point, of curved and phased arrays.

    Attributes
    ----------
    apex_mm : tuple of float
        x and y, in P, of the point where the lines meet.
    radius_mm : float
        Distance of the array's face from there; 0 for a phased array, whose lines begin at the apex.
    first_rad, step_rad : float
        Angle of the first line from straight down, towards growing x, and between neighbouring lines.
    """

    apex_mm: tuple[float, float]
    radius_mm: float
    first_rad: float
    step_rad: float


@dataclass(frozen=True)
class ImageGrid:
    """Grid of a frame's samples in the image plane P, mm.

    Attributes
    ----------
    vector_pitch_mm : float
        Distance of neighbouring vectors; of a fan's, along the arc at the middle sample.
    first_sample_depth_mm : float
        Of the first sample along its vector, from the array's face.
    first_vector_mm : float
        Lateral place of the first of parallel vectors.
    skew_rad : float
        Angle by which rows and vectors lean towards each other, half of it each, about the first sample: in
        images whose measured calibration is not square, when they are compounded; else zero.
    fan : FanLines, optional
        Where the vectors of a curved or phased array lie; without it they are parallel.
    """

    vectors: int
    samples: int
    vector_pitch_mm: float
    sample_spacing_mm: float
    first_sample_depth_mm: float = 0.0
    skew_rad: float = 0.0
    fan: FanLines | None = None
    first_vector_mm: float = 0.0

    def __post_init__(self) -> None:
        require_positive(self, ("vectors", "samples", "vector_pitch_mm", "sample_spacing_mm"))
        fan = self.fan
        if not np.isfinite(self.first_sample_depth_mm + self.first_vector_mm):
            raise InvalidInputError("first_sample_depth_mm, first_vector_mm: expected finite values")
        if fan is not None and not (
            np.isfinite(sum(fan.apex_mm, fan.radius_mm))
            and fan.radius_mm >= max(0.0, -self.first_sample_depth_mm)
            and fan.step_rad > 0
            and np.abs(self.angle_rad([0, self.vectors - 1])).max() <= np.pi / 2
        ):
            raise InvalidInputError(
                "fan: expected a finite apex, samples beyond it, and lines apart from each other within 90 "
                f"degrees of straight down, got {self.vectors} lines of {fan}"
            )

    @classmethod
    def of_fan(
        cls,
        vectors: int,
        samples: int,
        sample_spacing_mm: float,
        radius_mm: float,
        angles_rad: tuple[float, float],
        first_sample_depth_mm: float = 0.0,
    ) -> ImageGrid:
        """Grid of a curved array, or with `radius_mm` = 0 of a phased one; P begins at its image's top left.

        Parameters
        ----------
        vectors, samples : int
        sample_spacing_mm : float
            Along the lines.
        radius_mm : float
            Of the array's face.
        angles_rad : tuple of float
            Of the first and of the last line, from straight down and towards growing x.
        first_sample_depth_mm : float
            From the face.
        """
        first, last = angles_rad
        step = (last - first) / max(vectors - 1, 1)
        middle = radius_mm + first_sample_depth_mm + (samples - 1) / 2 * sample_spacing_mm
        fan = FanLines((0.0, 0.0), radius_mm, first, step)
        grid = cls(vectors, samples, middle * step, sample_spacing_mm, first_sample_depth_mm, fan=fan)
        left, top = grid.extent_mm[0]
        return replace(grid, fan=replace(fan, apex_mm=(float(-left), float(-top))))

    def angle_rad(self, vector: npt.ArrayLike) -> FloatArray:
        """Angle of vectors from straight down, towards growing x."""
        at = np.asarray(vector, dtype=float)
        return np.zeros(at.shape) if self.fan is None else self.fan.first_rad + at * self.fan.step_rad

    def mm(self, vector: npt.ArrayLike, sample: npt.ArrayLike) -> FloatArray:
        """Place of samples in P, shape (..., 2), mm; numbers may be fractional."""
        v, s = np.broadcast_arrays(vector, sample)
        place = np.asarray(np.stack([v, s, np.ones(v.shape)], axis=-1) @ self._from_sample.T)
        if self.fan is None:
            return place
        angle, radius = np.moveaxis(place, -1, 0)
        return np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=-1) + self.fan.apex_mm

    @property
    def places_mm(self) -> FloatArray:
        """Place of every sample in P, shape (vector, sample, 2), mm."""
        return self.mm(np.arange(self.vectors)[:, None], np.arange(self.samples))

    def sample_at(self, place_mm: npt.ArrayLike) -> FloatArray:
        """Fractional vector and sample at places in P, shape (..., 2); the inverse of `mm`."""
        place = np.asarray(place_mm, dtype=float)
        if self.fan is not None:
            x, y = np.moveaxis(place - self.fan.apex_mm, -1, 0)
            place = np.stack([np.arctan2(x, y), np.hypot(x, y)], axis=-1)
        return np.asarray((place - self._from_sample[:, 2]) @ np.linalg.inv(self._from_sample[:, :2]).T)

    @property
    def _from_sample(self) -> FloatArray:
        """Affine map from (vector, sample, 1) to x and y in P, or of a fan to angle and radius."""
        across, down, depth_mm = self.vector_pitch_mm, self.sample_spacing_mm, self.first_sample_depth_mm
        if self.fan is not None:
            first, step = self.fan.first_rad, self.fan.step_rad
            return np.array([[step, 0.0, first], [0.0, down, self.fan.radius_mm + depth_mm]])
        along, beside = np.cos(self.skew_rad / 2), np.sin(self.skew_rad / 2)
        x = [along * across, beside * down, self.first_vector_mm]
        return np.array([x, [beside * across, along * down, depth_mm]])

    @property
    def extent_mm(self) -> FloatArray:
        """Least and largest x and y of the samples in P, shape (2, 2), mm."""
        # The lowest point of a fan is straight down, if it has a line there.
        straight = 0.0 if self.fan is None else -self.fan.first_rad / self.fan.step_rad
        vectors = np.array([0.0, self.vectors - 1, np.clip(straight, 0, self.vectors - 1)])
        places = self.mm(vectors[:, None], [0, self.samples - 1]).reshape(-1, 2)
        return np.array([places.min(axis=0), places.max(axis=0)])

    @property
    def width_mm(self) -> float:
        """Width of the image, from the first to the last vector, mm."""
        return float(np.ptp(self.extent_mm[:, 0]))

    @property
    def depth_mm(self) -> float:
        """Depth of the last sample along its vector, mm."""
        return self.first_sample_depth_mm + (self.samples - 1) * self.sample_spacing_mm

    @property
    def centre_mm(self) -> FloatArray:
        """The image's centre in P, shape (3,), mm; of a fan, the middle sample of its middle line."""
        return np.append(self.mm((self.vectors - 1) / 2, (self.samples - 1) / 2), 0.0)

    @property
    def corners_mm(self) -> FloatArray:
        """The image's corners in P, clockwise from the top left (of a fan, its box's), shape (4, 3), mm."""
        v, s = self.vectors - 1, self.samples - 1
        corners = self.mm([0, v, v, 0], [0, 0, s, s])
        if self.fan is not None:
            corners = self.extent_mm[[[0, 0], [1, 0], [1, 1], [0, 1]], [0, 1]]
        return np.pad(corners, ((0, 0), (0, 1)))

    @property
    def image_from_sample(self) -> FloatArray:
        """Affine map from (vector, sample, 1) to (x, y, z, 1) in P, mm, shape (4, 3), of parallel vectors.

        Raises
        ------
        InvalidInputError
            If the vectors are a fan's, which no affine map places.
        """
        if self.fan is not None:
            raise InvalidInputError("expected parallel vectors, got a fan's: take its images scan-converted")
        return np.vstack([self._from_sample, [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])


def box_grid(fan: ImageGrid, pixel_mm: float) -> ImageGrid:
    """Grid of square pixels over the smallest box around a fan."""
    left, top = fan.extent_mm[0].tolist()
    steps = np.ceil(np.ptp(fan.extent_mm, axis=0) / pixel_mm - _ROUNDING).astype(int).tolist()
    return ImageGrid(steps[0] + 1, steps[1] + 1, pixel_mm, pixel_mm, top, first_vector_mm=left)


class ScanConversion:
    """Draws images of a fan on a rectangle about it.

    Parameters
    ----------
    fan : ImageGrid
        Of the images.
    grid : ImageGrid, optional
        Of the pictures; by default the box of the fan in square pixels, a quarter of the pitch of vectors or
        a sample wide.

    Attributes
    ----------
    grid : ImageGrid
        In the same image frame P.
    """

    def __init__(self, fan: ImageGrid, grid: ImageGrid | None = None) -> None:
        self.grid = grid or box_grid(fan, max(fan.vector_pitch_mm / _PIXELS_PER_PITCH, fan.sample_spacing_mm))
        # Places on the fan's edge are inside it whatever rounding does.
        self._sample = np.moveaxis(fan.sample_at(self.grid.places_mm).round(6), -1, 0)

    def __call__(self, image: AnyArray) -> Float32Array:
        """Picture of an image, shape (column, row), by linear interpolation; NaN outside the fan.

        Parameters
        ----------
        image : ndarray, shape (vector, sample)
        """
        return map_coordinates(
            np.asarray(image, np.float32), self._sample, np.float32, order=1, cval=np.nan, prefilter=False
        )


def require_positive(settings: object, names: tuple[str, ...]) -> None:
    """Raise `InvalidInputError` naming the first attribute that is not finite and above zero."""
    for name in names:
        value = getattr(settings, name)
        if not 0 < value < np.inf:
            raise InvalidInputError(f"{name}: expected a value above zero, got {value}")


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
        """Mask of the samples in the region, shape (vector, sample).

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

    def _inside(self, grid: ImageGrid) -> BoolArray:
        places = grid.places_mm
        inside = np.full(places.shape[:2], True)
        for part in self.text.split(" and "):
            try:
                kind, *words = part.split()
                inside &= _shape_mask(places, kind, [list(map(float, word.split(","))) for word in words])
            except ValueError:
                raise InvalidInputError(
                    f"region: expected {REGION_HELP}, joined by ' and ', got {self.text!r}"
                ) from None
        return inside


def polygon_mask(places: FloatArray, corners: npt.ArrayLike, name: str = "polygon") -> BoolArray:
    """Mask of places in a polygon, its sides included.

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
        If corners are too few.
    """
    outline = np.round(np.array(corners, float), 6)
    if outline.shape[1:] != (2,) or len(outline) < 3:
        raise InvalidInputError(f"{name}: expected shape (k, 2) with k of 3 or more, got {outline.shape}")
    inside = extra_module("skimage.measure", "calibrate", "a region").points_in_poly(
        np.round(places.reshape(-1, 2), 6), outline
    )
    return np.asarray(inside.reshape(places.shape[:2]))


def _shape_mask(places: FloatArray, kind: str, pairs: list[list[float]]) -> BoolArray:
    """Mask of places in a shape, its sides included; `ValueError` if it is none."""
    if kind == "polygon":
        return polygon_mask(places, pairs)
    if kind == "rectangle":
        (left, top), (right, bottom) = np.sort(pairs, 0)
        grid = ImageGrid(2, 2, right - left, bottom - top, top, first_vector_mm=left)
    elif kind == "fan":
        (x, y), angles_deg, (nearest, farthest) = pairs
        first, last = np.radians(angles_deg).tolist()
        grid = ImageGrid(2, 2, 1.0, farthest - nearest, fan=FanLines((x, y), nearest, first, last - first))
    else:
        raise ValueError(kind)
    sample = grid.sample_at(places)
    return np.asarray((np.abs(sample - sample.clip(0, 1)) < _ROUNDING).all(axis=-1))
