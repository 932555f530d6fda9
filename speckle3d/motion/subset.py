"""The orientation-consistent subset: patches whose distances agree with the orientation a sensor measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.motion.distances import PatchDistances


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
    distances: PatchDistances, raised_mm: FloatArray, support_sigma: float = 1.0, either_side: bool = True
) -> ConsistentSubset:
    """Patches whose distances agree on one plane of the orientation that the sensor measured.

    Every patch in turn places the plane, through +d and through -d; the placement that most others agree
    with, in magnitude and within `support_sigma` of their own deviations, keeps its supporters.

    Parameters
    ----------
    raised_mm : ndarray, shape (p,)
        How much farther each patch is than the image's centre, by the sensor's relative rotation.
    either_side : bool
        Whether the image's centre may lie on the other side of the first frame than `raised_mm` has it.

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, "Sensorless drift correction using
       orientation measurements", figure 4.
    """
    d, sigma = distances.distance_mm, distances.sigma_mm
    known = np.flatnonzero(np.isfinite(d))
    support = np.zeros(len(d), dtype=bool)
    if known.size == 0:
        return ConsistentSubset(support, np.ones(len(d)))
    raised = raised_mm[known]
    sides = (1.0, -1.0) if either_side else (1.0,)
    offsets = np.concatenate([side * d[known] - raised for side in sides])
    distance = np.abs(offsets[:, None] + raised)
    error = np.abs(distance - d[known]) / sigma[known]
    agree = error <= support_sigma
    # Among placements of equal support, the one whose supporters lie closest.
    score = agree.sum(axis=1) - np.where(agree, error, 0.0).sum(axis=1) / (agree.shape[1] * support_sigma + 1)
    best = int(np.argmax(score))
    support[known] = agree[best]
    return ConsistentSubset(support, np.where(offsets[best] + raised_mm < 0, -1.0, 1.0))
