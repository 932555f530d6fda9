"""The orientation-consistent subset: patches whose distances agree with a sensed orientation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.threads import in_parallel
from speckle3d.kernels.planes import agreeing_patches
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.distances import PatchDistances
from speckle3d.motion.estimate import Motion
from speckle3d.motion.planes import GRAIN, PAIRS_AT_ONCE, PairPlanes


def consistent_planes(
    motion: Motion, table: CorrelationTable, sensed: Rotation, direction: int
) -> PairPlanes:
    """Planes of the sensed orientation, through the patches that agree with it; their own if too few do.

    Parameters
    ----------
    sensed : Rotation, length n
        Orientation of every frame.
    direction : int
        Sign of the elevational motion, with which that of every pair is multiplied.
    """
    pairs, fitter = motion.pairs, motion.problem.fitter
    relative = (sensed[pairs.first].inv() * sensed[pairs.second]).as_matrix()[:, 2, :2]
    moved, slopes = table.inplane[pairs.row, :2], direction * pairs.sign[:, None] * relative
    offset, correlation = pairs.planes.offset_mm, table.correlation[pairs.row]
    agreed = np.empty(correlation.shape, dtype=bool)
    open_side = np.empty(len(pairs), dtype=bool)
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        some = slice(start, start + PAIRS_AT_ONCE)
        raised = fitter.raised(moved[some], slopes[some])
        # Only frames that cross, or nearly, leave the side open.
        open_side[some] = offset[some] < np.ptp(raised, axis=1)
        distances = fitter.distances(correlation[some], motion.coherence, pairs.first[some])
        distances = distances.scaled(motion.scale)
        agreed[some] = consistent_subset(distances, raised, fitter.settings.support_sigma, open_side[some])
    planes = fitter.fit(correlation, moved, motion.coherence, pairs.first, agreed, slopes, offset, open_side)
    # Slopes are the sensor's; distances have the scale of all patches.
    scaled = planes.scaled(motion.scale)
    planes = replace(scaled, coefficients=np.column_stack([scaled.offset_mm, planes.coefficients[:, 1:]]))
    return planes.where(planes.determined, pairs.planes)


def consistent_subset(
    distances: PatchDistances,
    raised_mm: FloatArray,
    support_sigma: float = 1.0,
    either_side: BoolArray | None = None,
) -> BoolArray:
    """Patches of each pair whose distances agree on one plane of the orientation that the sensor measured.

    Every patch in turn places the plane, through +d and through -d; the placement that most others agree
    with, in magnitude and within `support_sigma` of their own deviations, keeps its supporters.

    Parameters
    ----------
    distances : PatchDistances
        Of shape (e, p).
    raised_mm : ndarray, shape (e, p)
        How much farther each patch is than the image's centre, by the sensor's relative rotation.
    either_side : ndarray of bool, shape (e,), optional
        Whether the image's centre may lie on the other side of the first frame than `raised_mm` has it; it
        may in all pairs, if not given.

    Returns
    -------
    ndarray of bool, shape (e, p)

    References
    ----------
    .. [1] Housden et al., BioMedical Engineering OnLine 7:5, 2008, "Sensorless drift correction using
       orientation measurements", figure 4.
    """
    support = np.zeros(raised_mm.shape, dtype=bool)
    side = np.ones(len(support), dtype=bool) if either_side is None else either_side

    def work(first: int, stop: int) -> None:
        some = slice(first, stop)
        agreeing_patches(
            distances.distance_mm[some],
            distances.sigma_mm[some],
            raised_mm[some],
            side[some],
            support_sigma,
            support[some],
        )

    in_parallel(work, len(support), GRAIN)
    return support
