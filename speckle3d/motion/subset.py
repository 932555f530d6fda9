"""The orientation-consistent subset: patches whose distances agree with a sensed orientation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.sweep import Sweep
from speckle3d.motion.direction import SensorSettings, sensed_orientation
from speckle3d.motion.estimate import Motion, solve_planes
from speckle3d.motion.planes import pair_planes, patch_distances, raised


class ConsistentPoses(NamedTuple):
    """Poses from the orientation-consistent patches.

    Attributes
    ----------
    poses : RigidTransform, length n, or None
        None without a sensed orientation of every frame.
    used : ndarray of bool, shape (e, p)
        Patches of each pair that they come from.
    rejected_share : float
        Share of the measured patches that they do not come from; NaN without poses.
    """

    poses: RigidTransform | None
    used: BoolArray
    rejected_share: float


def consistent_poses(motion: Motion, sweep: Sweep, settings: SensorSettings) -> ConsistentPoses:
    """Poses from the orientation-consistent patches.

    Planes have the sensed orientation and go through the patches that agree with it; pairs of which too few
    do keep their own.

    Parameters
    ----------
    motion : Motion
        Of the true sign.
    sweep : Sweep
        With the sensors that are to be used.
    """
    orientation = sensed_orientation(sweep, settings)
    if orientation is None:
        return ConsistentPoses(None, motion.pairs.used, float("nan"))
    problem, table, pairs, scale = motion.problem, motion.table, motion.pairs, motion.coherence.scale
    models, correlation = motion.coherence.models(pairs.first), table.correlation[pairs.row]
    sign = np.where(pairs.offset_mm < 0, -1.0, 1.0)
    relative = (orientation[pairs.first].inv() * orientation[pairs.second]).as_matrix()[:, 2, :2]
    shift, slopes = table.inplane[pairs.row, :2], sign[:, None] * relative
    farther, offset = raised(problem, shift, slopes), np.abs(pairs.offset_mm)
    # Only frames that cross, or nearly, leave the side open.
    open_side = offset < np.ptp(farther, axis=1)
    distance, sigma = (scale * v for v in patch_distances(problem, correlation, models))
    agreement = consistent_subset(distance, sigma, farther, open_side, problem.planes.support_sigma)
    planes, firm = pair_planes(problem, table, pairs.row, models, offset, agreement, slopes, open_side)
    # Slopes are the sensor's; distances have the scale of all patches.
    planes.coefficients[:] *= [scale, 1.0, 1.0] * sign[:, None]
    planes.covariance[:] *= scale**2
    for name in ("coefficients", "covariance", "used"):
        getattr(planes, name)[~firm] = getattr(pairs, name)[~firm]
    rejected_share = 1.0 - float(planes.used[pairs.used].mean())
    return ConsistentPoses(solve_planes(problem, table, planes)[1].poses, planes.used, rejected_share)


def consistent_subset(
    distance_mm: FloatArray,
    sigma_mm: FloatArray,
    raised_mm: FloatArray,
    either_side: BoolArray,
    support_sigma: float = 1.0,
) -> BoolArray:
    """Patches of each pair whose distances agree on one plane of the orientation that the sensor measured.

    Every patch in turn places the plane, through +d and through -d; the placement that most others agree
    with, in magnitude and within `support_sigma` of their own deviations, keeps its supporters.

    Parameters
    ----------
    distance_mm, sigma_mm : ndarray, shape (e, p)
        NaN where a patch holds no distance.
    raised_mm : ndarray, shape (e, p)
        How much farther each patch is than the image's centre, by the sensor's relative rotation.
    either_side : ndarray of bool, shape (e,)
        Whether the image's centre may lie on the other side of the first frame than `raised_mm` has it.

    Returns
    -------
    ndarray of bool, shape (e, p)

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, "Sensorless drift correction using
       orientation measurements", figure 4.
    """
    support = np.zeros(raised_mm.shape, dtype=bool)
    for pair, finite in enumerate(np.isfinite(distance_mm)):
        if not finite.any():
            continue
        d, sigma, farther = (v[pair, finite].astype("f4") for v in (distance_mm, sigma_mm, raised_mm))
        offset = np.concatenate([d - farther, -d - farther] if either_side[pair] else [d - farther])
        misfit = np.abs((np.abs(offset[:, None] + farther) - d) / sigma)
        agree = misfit <= support_sigma
        # Among placements of equal support, the one whose supporters lie closest.
        score = agree.sum(axis=1) - (agree * misfit).sum(axis=1) / (d.size * support_sigma + 1.0)
        support[pair, finite] = agree[score.argmax()]
    return support
