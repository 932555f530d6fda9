"""The orientation-consistent subset: patches whose distances agree with a sensed orientation."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.motion.estimate import Motion, solve_planes
from speckle3d.motion.planes import pair_planes, patch_distances, raised


def consistent_poses(motion: Motion, sensed: Rotation) -> tuple[RigidTransform, BoolArray]:
    """Poses from the orientation-consistent patches, and each pair's patches used.

    Planes have the sensed orientation and go through the patches that agree with it; pairs of which too few
    do keep their own.

    Parameters
    ----------
    motion : Motion
        Of the true sign.
    sensed : Rotation, length n
        Orientation of every frame.
    """
    problem, table, pairs, scale = motion.problem, motion.table, motion.pairs, motion.coherence.scale
    models, correlation = motion.coherence.models(pairs.first), table.correlation[pairs.row]
    sign = np.where(pairs.offset_mm < 0, -1.0, 1.0)
    relative = (sensed[pairs.first].inv() * sensed[pairs.second]).as_matrix()[:, 2, :2]
    moved, slopes = table.inplane[pairs.row, :2], sign[:, None] * relative
    farther, offset = raised(problem, moved, slopes), np.abs(pairs.offset_mm)
    # Only frames that cross, or nearly, leave the side open.
    open_side = offset < np.ptp(farther, axis=1)
    distance, sigma = (scale * v for v in patch_distances(problem, correlation, models))
    agreed = consistent_subset(distance, sigma, farther, open_side, problem.planes.support_sigma)
    planes, determined = pair_planes(problem, table, pairs.row, models, offset, agreed, slopes, open_side)
    # Slopes are the sensor's; distances have the scale of all patches.
    planes.coefficients[:] *= [scale, 1.0, 1.0] * sign[:, None]
    planes.covariance[:] *= scale**2
    for name in ("coefficients", "covariance", "used"):
        getattr(planes, name)[~determined] = getattr(pairs, name)[~determined]
    return solve_planes(problem, table, planes)[1].poses, planes.used


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
    for pair, known in enumerate(np.isfinite(distance_mm)):
        if not known.any():
            continue
        d, sigma, farther = (v[pair, known].astype("f4") for v in (distance_mm, sigma_mm, raised_mm))
        offset = np.concatenate([d - farther, -d - farther] if either_side[pair] else [d - farther])
        misfit = np.abs((np.abs(offset[:, None] + farther) - d) / sigma)
        agree = misfit <= support_sigma
        # Among placements of equal support, the one whose supporters lie closest.
        score = agree.sum(axis=1) - (agree * misfit).sum(axis=1) / (d.size * support_sigma + 1.0)
        support[pair, known] = agree[score.argmax()]
    return support
