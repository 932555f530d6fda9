"""Distances, angles and lengths between points of a sweep, with their standard errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.poses import PoseErrors
from speckle3d.imaging.measures.belonging import Belonging, changes

NORMAL_95 = 1.959964
"""Deviations of a normal variable that 95 % of its values lie within."""
LEAST_MM = 1e-6
"""Points nearer than this are one."""


@dataclass(frozen=True)
class Measurement:
    """A length or an angle with its standard error.

    Attributes
    ----------
    kind : str
        "distance", "length" (of a line through several points) or "angle" (at a point).
    points : tuple of int
        Which of the points, from 0.
    value, pose_sigma, pick_sigma : float
        In `unit`; standard errors by the poses and by the picking of the points.
    unit : {"mm", "rad"}
    """

    kind: str
    points: tuple[int, ...]
    value: float
    pose_sigma: float
    pick_sigma: float
    unit: str = "mm"

    @property
    def sigma(self) -> float:
        """Standard error of the value."""
        return float(np.hypot(self.pose_sigma, self.pick_sigma))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the value; none reaches below zero, or past pi for angles."""
        half, most = NORMAL_95 * self.sigma, math.pi if self.unit == "rad" else math.inf
        return max(self.value - half, 0.0), min(self.value + half, most)

    @property
    def shown_in(self) -> tuple[float, str]:
        """Factor to the displayed unit, and that unit: mm or degrees."""
        return (1.0, "mm") if self.unit == "mm" else (math.degrees(1.0), "degrees")

    @property
    def line(self) -> str:
        """The value and the half width of its 95 % interval, by poses and by picking."""
        scale, unit = self.shown_in
        numbers = " ".join(str(number + 1) for number in self.points)
        sigmas = (self.sigma, self.pose_sigma, self.pick_sigma)
        half, by_poses, by_picking = (f"{NORMAL_95 * scale * sigma:.2f}" for sigma in sigmas)
        errors = f"95 %; poses {by_poses}, picking {by_picking}"
        return f"{self.kind} {numbers}: {self.value * scale:.2f} +- {half} {unit} ({errors})"


def measure_points(
    points_mm: FloatArray, belonging: Belonging, errors: PoseErrors, pick_mm: float
) -> list[Measurement]:
    """Measure distances of points in a row, their sum, and the angles at the points between.

    Parameters
    ----------
    points_mm : ndarray, shape (k, 3)
        In the world, k >= 2, in order.
    belonging : Belonging
        Of the points; see `speckle3d.imaging.measures.belonging`.
    errors : PoseErrors
    pick_mm : float
        Standard deviation of each point's place on each axis by picking.

    Raises
    ------
    InvalidInputError
        If there are fewer than two points, or two in a row are one.
    """
    points = np.asarray(points_mm, dtype=float)
    if len(points) < 2:
        raise InvalidInputError(f"expected at least 2 points to measure between, got {len(points)}")
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if (steps < LEAST_MM).any():
        first = int(np.flatnonzero(steps < LEAST_MM)[0]) + 1
        raise InvalidInputError(f"points {first} and {first + 1}: expected two places, got one")

    def row(kind: str, numbers: range, quantity: Quantity, unit: str = "mm") -> Measurement:
        value, gradient = quantity(points[numbers])
        by_poses = changes(errors, points[numbers], gradient, belonging.of_points(np.array(numbers)))
        pose_sigma, pick_sigma = float(np.linalg.norm(by_poses)), pick_mm * float(np.linalg.norm(gradient))
        return Measurement(kind, tuple(numbers), value, pose_sigma, pick_sigma, unit)

    rows = [row("distance", range(k, k + 2), length) for k in range(len(points) - 1)]
    rows += [row("length", range(len(points)), length)] if len(points) > 2 else []
    rows += [row("angle", range(k, k + 3), angle, "rad") for k in range(len(points) - 2)]
    return rows


Quantity = Callable[[FloatArray], tuple[float, FloatArray]]
"""Value of some points, and its derivative with respect to each, shape (k, 3)."""


def length(points_mm: FloatArray) -> tuple[float, FloatArray]:
    """Length of the line through points, and its derivative, shape (k, 3)."""
    steps = np.diff(points_mm, axis=0)
    sizes = np.linalg.norm(steps, axis=1, keepdims=True)
    gradient = np.zeros_like(points_mm)
    gradient[1:] += steps / sizes
    gradient[:-1] -= steps / sizes
    return float(sizes.sum()), gradient


def angle(points_mm: FloatArray) -> tuple[float, FloatArray]:
    """Angle at the second of three points, rad, and its derivative, shape (3, 3)."""
    sides = points_mm[[0, 2]] - points_mm[1]
    sizes = np.linalg.norm(sides, axis=1, keepdims=True)
    first, second = sides / sizes
    normal = np.cross(first, second)
    sine, cosine = float(np.linalg.norm(normal)), float(first @ second)
    # Along a straight line every turn opens or closes the angle alike, to first order of its size.
    across = normal / sine if sine > 1e-9 else np.linalg.svd(first[None])[2][2]
    ends = np.array([np.cross(first, across), -np.cross(second, across)]) / sizes
    gradient = np.array([ends[0], -ends.sum(axis=0), ends[1]])
    return float(np.arctan2(sine, cosine)), gradient
