"""How well two crossing sweeps determine the calibration: by leaving out one part of the tissue after another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.crossing import Crossing
from calibration.imagefit import Refined, about_pivot
from speckle3d.core.geometry import FloatArray, skew

BLOCK_MM = 8.0
"""Side of the blocks of tissue left out: wider than a patch, since patches that overlap err alike."""

NAMES = ("tilt", "yaw", "roll", "x", "y", "z", "lateral pixel size", "axial pixel size")


@dataclass(frozen=True)
class Spread:
    """Covariance of turns, displacements and relative pixel sizes at the image's origin, shape (8, 8)."""

    covariance: FloatArray
    condition_number: float
    weakest: str


def covariance_at_origin(crossing: Crossing, refined: Refined) -> Spread:
    """Jackknife over blocks of tissue, each left out by one Gauss-Newton step.

    References
    ----------
    .. [1] R. M. Bell and D. F. McCaffrey, "Bias reduction in standard errors for linear regression with
       multi-stage samples", Survey Methodology, 2002 (leaving out a cluster at a time).
    """
    likeness, chosen = refined.likeness, np.array(refined.free)
    base = about_pivot(refined.pivot_mm)[:, chosen]
    normal = base.T @ (refined.weight[:, None, None] * likeness.normal) @ base
    gradient = (refined.weight[:, None] * likeness.gradient) @ base
    block = _blocks(crossing, refined)
    total, slope = normal.sum(axis=0), gradient.sum(axis=0)
    norms = np.sqrt(np.diag(total))
    if not (norms > 0).all() or block.max(initial=0) < 1:
        return Spread(_embedded(np.full((len(chosen),) * 2, np.inf), chosen), float("inf"), "all")
    values, vectors = np.linalg.eigh(total / np.outer(norms, norms))
    condition = float(np.sqrt(values[-1] / max(values[0], 1e-300)))
    weakest = NAMES[chosen[np.argmax(np.abs(vectors[:, 0]))]]
    count = block.max() + 1
    left = np.empty((count, len(chosen)))
    for number in range(count):
        out = block == number
        left[number] = np.linalg.lstsq(
            total - normal[out].sum(axis=0), slope - gradient[out].sum(axis=0), rcond=None
        )[0]
    left -= left.mean(axis=0)
    covariance = (count - 1) / count * left.T @ left
    return Spread(_embedded(base @ covariance @ base.T, np.arange(8)), condition, weakest)


def point_covariance(covariance: FloatArray, point_mm: FloatArray) -> FloatArray:
    """Covariance of a point of the image from that of its pose at the image's origin, shape (3, 3)."""
    moved = np.hstack([-skew(np.asarray(point_mm, dtype=float)), np.eye(3)])
    return np.asarray(moved @ covariance @ moved.T)


def _embedded(covariance: FloatArray, chosen: FloatArray) -> FloatArray:
    full = np.zeros((8, 8))
    full[np.ix_(chosen, chosen)] = covariance
    return full


def _blocks(crossing: Crossing, refined: Refined) -> FloatArray:
    """Number of the block of tissue in which each patch lies, from zero."""
    place = refined.places_mm
    cell = np.floor(place / (BLOCK_MM * crossing.unit)).astype(int)
    counted = refined.weight > 0
    numbers = np.full(len(cell), -1)
    if counted.any():
        numbers[counted] = np.unique(cell[counted], axis=0, return_inverse=True)[1].ravel()
    return numbers
