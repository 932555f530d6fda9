"""Similarity about an answer, as the published figure 4 shows it: one parameter at a time, or two at once.

References
----------
.. [1] W. Wein and A. Khamene, "Image-based method for in-vivo freehand ultrasound calibration", SPIE Medical
   Imaging, 2008, figure 4.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from calibration.images.crossing import Crossing
from calibration.images.fit import Estimate
from calibration.images.simplex import incremented
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError

AXES = ("tilt", "yaw", "roll", "x", "y", "z")
"""Turns about the image's x, y, z in degrees, displacements along them in mm, applied at its origin."""

IMAGES = 10
SIGMA_MM = 1.0


@dataclass(frozen=True)
class SimilarityCurves:
    """Mean correlation of images with cuts of the other sweep, one parameter moved at a time.

    Attributes
    ----------
    offset : ndarray, shape (k,)
        Degrees for the first three axes, mm for the others.
    similarity : ndarray, shape (6, k)
        By `AXES`; NaN where no image overlaps the other sweep by three tenths.
    """

    offset: FloatArray
    similarity: FloatArray


@dataclass(frozen=True)
class SimilarityMap:
    """Mean correlation with two parameters moved at once, shape (k, k), the first along the first axis."""

    axes: tuple[str, str]
    offset: FloatArray
    similarity: FloatArray


def similarity_curves(
    crossing: Crossing,
    sensor_from_image: RigidTransform,
    span: float = 10.0,
    points: int = 21,
    scales: FloatArray | None = None,
    threads: int = 2,
) -> SimilarityCurves:
    """Similarity along each parameter, from -`span` to `span` mm or degrees about a calibration."""
    offset = _offsets(span, points)
    steps = (step * np.eye(6)[axis] for axis in range(6) for step in offset)
    found = _similarities(crossing, _estimate(sensor_from_image, scales), steps, threads)
    return SimilarityCurves(offset, found.reshape(6, points))


def similarity_map(
    crossing: Crossing,
    sensor_from_image: RigidTransform,
    axes: tuple[str, str],
    span: float = 10.0,
    points: int = 21,
    scales: FloatArray | None = None,
    threads: int = 2,
) -> SimilarityMap:
    """Similarity over two parameters, named as in `AXES`."""
    for name in axes:
        if name not in AXES:
            raise InvalidInputError(f"axes: expected two of {', '.join(AXES)}, got {name!r}")
    offset = _offsets(span, points)
    one, other = (np.eye(6)[AXES.index(name)] for name in axes)
    steps = (a * one + b * other for a in offset for b in offset)
    found = _similarities(crossing, _estimate(sensor_from_image, scales), steps, threads)
    return SimilarityMap(axes, offset, found.reshape(points, points))


def _similarities(
    crossing: Crossing, about: Estimate, steps: Iterator[FloatArray], threads: int
) -> FloatArray:
    comparison = crossing.whole(SIGMA_MM, IMAGES, about.sensor_from_image)

    def at(step: FloatArray) -> float:
        moved = incremented(about, step)
        return comparison.at(moved.sensor_from_image, moved.scales).mean

    with ThreadPoolExecutor(threads) as pool:
        return np.array(list(pool.map(at, steps)))


def _offsets(span: float, points: int) -> FloatArray:
    if not (np.isfinite(span) and span > 0 and points >= 2):
        raise InvalidInputError(
            f"expected a span above zero and at least two points, got {span:g} and {points}"
        )
    return np.linspace(-span, span, points)


def _estimate(sensor_from_image: RigidTransform, scales: FloatArray | None) -> Estimate:
    return Estimate(sensor_from_image, np.ones(2) if scales is None else scales)
