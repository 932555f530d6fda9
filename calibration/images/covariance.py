"""How well two crossing sweeps determine the calibration, by how far their parts disagree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.images.curvature import Settled
from calibration.images.fit import Refined, about_pivot
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import skew

BLOCK_MM = 16.0
"""Side of the blocks of tissue that err together, in units of the images' size: some patches wide, as
neighbours see the same reflections."""

STRETCH = 3
"""Images compared that err together: a tracker's error lasts from one to the next."""

SHARED_RAD = np.deg2rad(0.1)
SHARED_MM = (0.03, 0.1, 0.04)
"""Standard deviations, turns and displacements of the image's centre across, along the beam and out of plane,
of what all of the tissue shares and no part of it can show: root mean squares of what was left over six
simulated pairs of sweeps, whatever the start. A thick beam shows what is beside it deeper than it is."""

NAMES = ("tilt", "yaw", "roll", "x", "y", "z", "lateral pixel size", "axial pixel size")


@dataclass(frozen=True)
class Spread:
    """Covariance of turns, displacements and relative pixel sizes at the image's origin, shape (8, 8)."""

    covariance: FloatArray
    condition_number: float
    weakest: str


def covariance_at_origin(settled: Settled, unit: float) -> Spread:
    """Sandwich of the curvature and of how slopes differ between blocks of tissue and stretches of sweeps.

    What differs from block to block of tissue (speckle, reflections) and from image to image (poses) adds up.
    Poses count twice: those of the images compared, and those of the images cut, of which there are as many.
    What all of the tissue shares is added (`SHARED_MM`).

    Parameters
    ----------
    unit : float
        Size of the images relative to the usual.

    References
    ----------
    .. [1] P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 5th
       Berkeley Symposium on Mathematical Statistics and Probability, 1967.
    """
    refined = settled.refined
    chosen = np.array(refined.free)
    base = about_pivot(refined.pivot_mm)[:, chosen]
    slopes = (refined.weight[:, None] * refined.likeness.gradient) @ base
    norms = np.sqrt(np.diag(settled.curvature))
    values, vectors = np.linalg.eigh(settled.curvature / np.outer(norms, norms))
    condition = float(np.sqrt(values[-1] / max(values[0], 1e-300)))
    tissue = _scatter(slopes, _numbered(np.floor(refined.places_mm / (BLOCK_MM * unit))))
    poses = _scatter(slopes, _numbered(np.column_stack(_stretches(refined))))
    moved = base @ np.linalg.inv(settled.curvature)
    covariance = moved @ (tissue + 2.0 * poses) @ moved.T + _shared(refined.pivot_mm, unit)
    return Spread(covariance, condition, NAMES[chosen[np.argmax(np.abs(vectors[:, 0]))]])


def _shared(pivot_mm: FloatArray, unit: float) -> FloatArray:
    """Covariance at the origin of what no part of the tissue can show; pixel sizes have none."""
    variance = np.concatenate([np.full(3, SHARED_RAD), unit * np.array(SHARED_MM), np.zeros(2)]) ** 2
    base = about_pivot(pivot_mm)
    return np.asarray(base @ np.diag(variance) @ base.T)


def _scatter(slopes: FloatArray, cluster: IntArray) -> FloatArray:
    """Covariance of the sum of patches' slopes, if those of one cluster err together."""
    count = int(cluster.max()) + 1
    if count < 2:
        raise InsufficientDataError(
            "expected sweeps that share more tissue, got too little to compare its parts"
        )
    sums = np.zeros((count, slopes.shape[1]))
    np.add.at(sums, cluster, slopes)
    sums -= sums.mean(axis=0)
    return np.asarray(count / (count - 1.0) * sums.T @ sums)


def _numbered(cells: FloatArray) -> IntArray:
    """Number of each patch's cell, from zero."""
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1], dtype=np.int64).ravel()


def _stretches(refined: Refined) -> tuple[IntArray, IntArray]:
    """Sweep, and stretch of it, that each patch's image belongs to."""
    sweep, image = refined.comparison.images.T
    return sweep, _numbered(np.column_stack([sweep, image])) // STRETCH


def point_covariance(covariance: FloatArray, point_mm: FloatArray) -> FloatArray:
    """Covariance of a point of the image from that of its pose at the image's origin, shape (3, 3)."""
    moved = np.hstack([-skew(np.asarray(point_mm, dtype=float)), np.eye(3)])
    return np.asarray(moved @ covariance @ moved.T)
