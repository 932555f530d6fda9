"""A plane through the patches' distances: the second frame seen from the first.

z(x, y) = a + b (x - xc) + c (y - yc) for points of the second frame, about the image's centre, where
b = R31 and c = R32 of the relative rotation. Distances are unsigned; the plane returned has a >= 0 and
its sign is settled by the trajectory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.geometry import FloatArray
from speckle3d.core.streams import BoolArray
from speckle3d.motion.distances import DistanceEstimator, EchoModel, PatchDistances


class PlaneSettings(BaseModel):
    """How planes are fitted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bias_mm: float = Field(
        0.02,
        ge=0,
        description="Error common to a pair's distances that no number of patches averages out; it keeps "
        "tiny separations from outweighing long ones.",
    )
    huber: float = Field(1.5, gt=0, description="Standard deviations at which a patch begins to lose weight.")
    support_sigma: float = Field(
        1.0,
        gt=0,
        description="Threshold of the orientation-consistent subset, standard deviations. One is published; "
        "distances being skewed, it makes phantom sweeps 0.3 % longer, and two leaves them as they are.",
    )


@dataclass(frozen=True)
class PairPlane:
    """Plane of one frame pair.

    Attributes
    ----------
    offset_mm, slope_x, slope_y : float
        a, b and c.
    covariance : ndarray, shape (3, 3)
        Of (a, b, c).
    used : ndarray of bool, shape (p,)
        Patches that took part.
    """

    offset_mm: float
    slope_x: float
    slope_y: float
    covariance: FloatArray
    used: BoolArray

    @property
    def coefficients(self) -> FloatArray:
        """(a, b, c)."""
        return np.array([self.offset_mm, self.slope_x, self.slope_y])


def fit_plane(
    distances: PatchDistances,
    estimator: DistanceEstimator,
    at_mm: FloatArray,
    settings: PlaneSettings | None = None,
    subset: BoolArray | None = None,
    model: EchoModel | None = None,
    side: FloatArray | None = None,
) -> PairPlane | None:
    """Robust weighted least squares; None if fewer than six patches can take part.

    Each patch is weighted by the deviation expected at the plane's distance, not at its own: weights
    taken from the estimates themselves favour those that came out short.

    Parameters
    ----------
    at_mm : ndarray, shape (p, 2)
        Patch centres less the image's centre.
    subset : ndarray of bool, shape (p,), optional
        Patches allowed to take part.
    model : EchoModel, optional
        With which the distances were made.
    side : ndarray of +1 and -1, shape (p,), optional
        On which side of the first frame each patch lies, where that is known; without it all on one.
    """
    s = settings or PlaneSettings()
    d = distances.distance_mm
    used = np.isfinite(d) if subset is None else np.isfinite(d) & subset
    if used.sum() < 6:
        return None
    design = np.column_stack([np.ones(len(d)), at_mm])
    predicted = np.full(len(d), np.median(d[used]))  # only its size matters
    robust = np.ones(len(d))
    data = np.nan_to_num(d) if side is None else np.nan_to_num(d) * side
    for _ in range(5):
        sigma = estimator.sigma(np.abs(predicted), model)
        weight = used * robust / sigma**2
        inverse = _inverse(design.T @ (design * weight[:, None]))
        plane = inverse @ (design.T @ (weight * data))
        predicted = design @ plane
        size = np.abs(data - predicted) / sigma
        robust = np.minimum(1.0, s.huber / np.maximum(size, 1e-9))
    excess = max(1.0, float((weight * (data - predicted) ** 2).sum() / max(used.sum() - 3, 1)))
    covariance = np.asarray(inverse * excess, dtype=float)
    covariance[0, 0] += s.bias_mm**2
    if plane[0] < 0:
        plane = -plane
    return PairPlane(float(plane[0]), float(plane[1]), float(plane[2]), covariance, used)


@dataclass(frozen=True)
class ConsistentSubset:
    """Patches that agree on an oriented plane, and on which side of the first frame it has them.

    Attributes
    ----------
    support : ndarray of bool, shape (p,)
    side : ndarray of +1 and -1, shape (p,)
    """

    support: BoolArray
    side: FloatArray


def consistent_subset(
    distances: PatchDistances, at_mm: FloatArray, slopes: FloatArray, settings: PlaneSettings | None = None
) -> ConsistentSubset:
    """Patches whose distances agree on one plane of the orientation that the sensor measured.

    Every patch in turn places the plane, through +d and through -d; the placement that most others agree
    with, in magnitude and within `support_sigma` of their own deviations, keeps its supporters.

    Parameters
    ----------
    slopes : ndarray, shape (2,)
        R31 and R32 of the relative rotation from the sensor.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, "Sensorless drift correction using
       orientation measurements", figure 4.
    """
    s = settings or PlaneSettings()
    d, sigma = distances.distance_mm, distances.sigma_mm
    known = np.flatnonzero(np.isfinite(d))
    support = np.zeros(len(d), dtype=bool)
    if known.size == 0:
        return ConsistentSubset(support, np.ones(len(d)))
    tilt = at_mm[known] @ slopes
    offsets = np.concatenate([d[known] - tilt, -d[known] - tilt])
    distance = np.abs(offsets[:, None] + tilt)
    error = np.abs(distance - d[known]) / sigma[known]
    agree = error <= s.support_sigma
    # Among placements of equal support, the one whose supporters lie closest.
    score = agree.sum(axis=1) - np.where(agree, error, 0.0).sum(axis=1) / (
        agree.shape[1] * s.support_sigma + 1
    )
    best = int(np.argmax(score))
    support[known] = agree[best]
    return ConsistentSubset(support, np.where(offsets[best] + at_mm @ slopes < 0, -1.0, 1.0))


def _inverse(normal: FloatArray) -> FloatArray:
    """Inverse of a 3 x 3 normal matrix; slopes that the patches do not determine get a huge variance."""
    slack = 1e-9 * np.diag(normal).max() * np.array([1e-6, 1.0, 1.0])
    return np.asarray(np.linalg.inv(normal + np.diag(slack)))
