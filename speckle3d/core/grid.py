"""Where the samples of an image lie: vectors that are parallel, or spread as a fan."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError

_ROUNDING = 1e-6
"""Of a pitch, by which a place may miss the first or the last sample and be in the image."""


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
    """Where the samples of a frame lie in the image plane P, mm.

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
        if not np.isfinite([self.first_sample_depth_mm, self.first_vector_mm]).all():
            raise InvalidInputError("first_sample_depth_mm, first_vector_mm: expected finite values")
        fan = self.fan
        if fan is not None and not (
            np.isfinite([*fan.apex_mm, fan.radius_mm]).all()
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
        v, s = np.broadcast_arrays(np.asarray(vector, dtype=float), sample)
        if self.fan is None:
            return np.asarray(np.stack([v, s, np.ones(v.shape)], axis=-1) @ self.image_from_sample[:2].T)
        angle = self.angle_rad(v)
        radius = self.fan.radius_mm + self.first_sample_depth_mm + s * self.sample_spacing_mm
        return np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=-1) + self.fan.apex_mm

    def sample_at(self, place_mm: npt.ArrayLike) -> FloatArray:
        """Fractional vector and sample at places in P, shape (..., 2); the inverse of `mm`."""
        place = np.asarray(place_mm, dtype=float)
        if self.fan is None:
            axes, first = np.split(self.image_from_sample[:2], [2], axis=1)
            return np.asarray((place - first.T[0]) @ np.linalg.inv(axes).T)
        x, y = np.moveaxis(place - self.fan.apex_mm, -1, 0)
        depth = np.hypot(x, y) - self.fan.radius_mm - self.first_sample_depth_mm
        vector = (np.arctan2(x, y) - self.fan.first_rad) / self.fan.step_rad
        return np.stack([vector, depth / self.sample_spacing_mm], axis=-1)

    def holds(self, place_mm: npt.ArrayLike) -> BoolArray:
        """Which places in P, shape (..., 2), lie among the samples, the outermost included."""
        sample, last = self.sample_at(place_mm), [self.vectors - 1, self.samples - 1]
        return np.asarray((np.abs(sample - np.clip(sample, 0, last)) < _ROUNDING).all(axis=-1))

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
            (left, top), (right, bottom) = self.extent_mm
            corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
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
        along, beside = np.cos(self.skew_rad / 2), np.sin(self.skew_rad / 2)
        across, down = self.vector_pitch_mm, self.sample_spacing_mm
        x = [along * across, beside * down, self.first_vector_mm]
        y = [beside * across, along * down, self.first_sample_depth_mm]
        return np.array([x, y, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def require_positive(settings: object, names: tuple[str, ...]) -> None:
    """Raise `InvalidInputError` naming the first attribute that is not finite and above zero."""
    for name in names:
        value = getattr(settings, name)
        if not 0 < value < np.inf:
            raise InvalidInputError(f"{name}: expected a value above zero, got {value}")
