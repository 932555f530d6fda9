"""How well two crossing sweeps determine the calibration: by leaving out one part after another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.imagefit import Refined, about_pivot
from calibration.imagestacks import IntArray
from speckle3d.core.geometry import FloatArray, skew

BLOCK_MM = 16.0
"""Side of the blocks of tissue left out, in units of the images' size: some patches wide, as neighbours see
the same reflections and so err alike."""

STRETCH = 3
"""Images compared that are left out together: a tracker's error lasts from one to the next."""

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


def covariance_at_origin(refined: Refined, unit: float) -> Spread:
    """Jackknife over blocks of tissue and over stretches of the sweeps, left out by one Gauss-Newton step.

    What differs from block to block of tissue (speckle, reflections) and from image to image (poses) adds up.
    Poses count twice: those of the images compared, and those of the images cut, of which there are as many.
    What all of the tissue shares is added (`SHARED_MM`).

    Parameters
    ----------
    unit : float
        Size of the images relative to the usual.

    References
    ----------
    .. [1] R. M. Bell and D. F. McCaffrey, "Bias reduction in standard errors for linear regression with
       multi-stage samples", Survey Methodology, 2002 (leaving out a cluster at a time).
    """
    chosen = np.array(refined.free)
    base = about_pivot(refined.pivot_mm)[:, chosen]
    normal = base.T @ (refined.weight[:, None, None] * refined.likeness.normal) @ base
    gradient = (refined.weight[:, None] * refined.likeness.gradient) @ base
    total = normal.sum(axis=0)
    norms = np.sqrt(np.diag(total))
    if not (norms > 0).all():
        return Spread(_held(np.full(total.shape, np.inf), chosen), float("inf"), "all")
    values, vectors = np.linalg.eigh(total / np.outer(norms, norms))
    condition = float(np.sqrt(values[-1] / max(values[0], 1e-300)))
    tissue = _jackknife(normal, gradient, _numbered(np.floor(refined.places_mm / (BLOCK_MM * unit))))
    poses = _jackknife(normal, gradient, _numbered(np.column_stack(_stretches(refined))))
    covariance = base @ (tissue + 2.0 * poses) @ base.T + _shared(refined.pivot_mm, unit)
    return Spread(covariance, condition, NAMES[chosen[np.argmax(np.abs(vectors[:, 0]))]])


def _shared(pivot_mm: FloatArray, unit: float) -> FloatArray:
    """Covariance at the origin of what no part of the tissue can show; pixel sizes have none."""
    variance = np.concatenate([np.full(3, SHARED_RAD), unit * np.array(SHARED_MM), np.zeros(2)]) ** 2
    base = about_pivot(pivot_mm)
    return np.asarray(base @ np.diag(variance) @ base.T)


def _jackknife(normal: FloatArray, gradient: FloatArray, cluster: IntArray) -> FloatArray:
    """Covariance from the Gauss-Newton steps that follow from leaving out each cluster of patches."""
    total, slope, count = normal.sum(axis=0), gradient.sum(axis=0), int(cluster.max()) + 1
    if count < 2:
        return np.full(total.shape, np.inf)
    steps = np.empty((count, len(total)))
    for number in range(count):
        out = cluster == number
        left = total - normal[out].sum(axis=0)
        steps[number] = np.linalg.lstsq(left, slope - gradient[out].sum(axis=0), rcond=None)[0]
    steps -= steps.mean(axis=0)
    return np.asarray((count - 1) / count * steps.T @ steps)


def _numbered(cells: FloatArray) -> IntArray:
    """Number of each patch's cell, from zero."""
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1], dtype=np.int64).ravel()


def _stretches(refined: Refined) -> tuple[IntArray, IntArray]:
    """Sweep, and stretch of it, that each patch's image belongs to."""
    sweep, image = refined.sources.T
    return sweep, _numbered(np.column_stack([sweep, image])) // STRETCH


def _held(covariance: FloatArray, chosen: IntArray) -> FloatArray:
    full = np.zeros((len(NAMES),) * 2)
    full[np.ix_(chosen, chosen)] = covariance
    return full


def point_covariance(covariance: FloatArray, point_mm: FloatArray) -> FloatArray:
    """Covariance of a point of the image from that of its pose at the image's origin, shape (3, 3)."""
    moved = np.hstack([-skew(np.asarray(point_mm, dtype=float)), np.eye(3)])
    return np.asarray(moved @ covariance @ moved.T)
