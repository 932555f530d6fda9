"""From correlations of frame pairs to signed planes and the path of the sweep."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.relative import RelativePoses
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.coherence import (
    Coherence,
    PatchCorrelations,
    RowScales,
    estimate_coherence,
    scale_sigma,
)
from speckle3d.motion.distances import LEAST_CORRELATION, DistanceEstimator
from speckle3d.motion.lens import with_fitted_lens
from speckle3d.motion.planes import PairPlanes, PlaneFitter, PlaneSettings
from speckle3d.motion.signs import (
    ADAPTED_ERROR,
    PLAIN_ERROR,
    SignedPairs,
    Strangers,
    pair_signs,
    settled_path,
)
from speckle3d.motion.trajectory import relative_poses_of, solve_trajectory
from speckle3d.motion.uncertainty import SlopeEvidence, weigh_slopes

ROUNDS = 2
"""Rounds in which shares and scale, and the path that they are read from, are estimated in turn; a third
moves lengths by less than 0.2 %."""
LENS_ROUNDS = 4
"""Fits of a data sheet's lens: a path read with a wrong lens bends the rows otherwise than the right one."""
ENOUGH_PAIRS = 3
"""Pairs to earlier frames from which a frame needs none that tells less."""


@dataclass(frozen=True)
class MotionProblem:
    """What the correlations of one sweep are read with.

    Attributes
    ----------
    curves : DecorrelationCurves
    patches : PatchGrid
    centre_mm : ndarray, shape (3,)
        The image's centre.
    frames : int
        Of the sweep.
    planes : PlaneSettings
    trajectory : TrajectorySettings
    adapt : bool
        Whether structure and noise are adapted to.
    """

    curves: DecorrelationCurves
    patches: PatchGrid
    centre_mm: FloatArray
    frames: int
    planes: PlaneSettings
    trajectory: TrajectorySettings
    adapt: bool = True

    def with_curves(self, curves: DecorrelationCurves) -> MotionProblem:
        """Return the same problem with other curves."""
        return replace(self, curves=curves)

    @cached_property
    def fitter(self) -> PlaneFitter:
        """Fitter of planes to the patches of a pair."""
        estimator = DistanceEstimator(self.curves, self.patches)
        return PlaneFitter(estimator, self.patches.centre_mm - self.centre_mm[:2], self.planes)


@dataclass(frozen=True)
class Motion:
    """Signed planes of a sweep's frame pairs, and what they were read with.

    Attributes
    ----------
    problem : MotionProblem
        With the curves as they were read in the end.
    pairs : SignedPairs
    coherence : Coherence or None
        Share of structure and gain of every patch; None if not adapted to.
    rows : RowScales or None
        Scales that rows of patches ask for; None if not adapted to.
    path : ndarray, shape (n, 3)
        Elevational position of the image's centre and slopes along x and y of every frame.
    scale : float
        Of all distances over those that planes fitted with `coherence` have; in `pairs` and `path`.
    """

    problem: MotionProblem
    pairs: SignedPairs
    coherence: Coherence | None
    rows: RowScales | None
    path: FloatArray
    scale: float = 1.0

    @property
    def structure(self) -> float:
        """Mean share of structure."""
        return 0.0 if self.coherence is None else float(self.coherence.share.mean())

    @property
    def slopes(self) -> SlopeEvidence:
        """Weight of the slopes that the planes have."""
        return slope_evidence(self.problem, self.pairs, self.coherence)


def estimate_motion(problem: MotionProblem, table: CorrelationTable, sound: BoolArray) -> Motion:
    """Estimate shares of structure, the scale of distances and the path, each from the others, in turn.

    Distances and their scale need the path, the path needs distances: both are repeated `ROUNDS` times. For
    curves from a data sheet the lens is fitted to what depths then disagree on, and all is read again with
    it.

    Parameters
    ----------
    table : CorrelationTable
    sound : ndarray of bool, shape (e,)
        Pairs both of whose frames are to be trusted.

    Raises
    ------
    InsufficientDataError
        If no pair determines a plane.
    """
    path = rough_path(problem, table)
    if problem.curves.origin == "data sheet" and problem.adapt:
        # Tilt bends rows as a lens does: it is left out until the lens is known.
        tilt, problem = problem.curves.tilt, problem.with_curves(replace(problem.curves, tilt=None))
        assert problem.curves.nominal is not None
        focus_mm = problem.curves.nominal.focus_mm
        for _ in range(LENS_ROUNDS):
            motion = _in_turn(problem, table, sound, path)
            assert motion.rows is not None
            curves = with_fitted_lens(problem.curves, motion.rows, focus_mm)
            problem, path = problem.with_curves(curves), motion.path
        problem = problem.with_curves(replace(problem.curves, tilt=tilt))
    return _in_turn(problem, table, sound, path)


def _in_turn(problem: MotionProblem, table: CorrelationTable, sound: BoolArray, path: FloatArray) -> Motion:
    """Shares and scale from the path, the path from distances, in turn; at last the scale of all patches."""
    if not problem.adapt:
        pairs = _signed(
            problem, table, sound, unsigned_planes(problem, table, path, sound, None), PLAIN_ERROR
        )
        return Motion(problem, pairs, None, None, path_of(problem, table, pairs, None))
    coherence, scale, rows = coherence_of(problem, table, path, sound)
    for _ in range(ROUNDS):
        planes = unsigned_planes(problem, table, path * scale, sound, coherence)
        pairs = _signed(problem, table, sound, planes, ADAPTED_ERROR)
        path = path_of(problem, table, pairs, coherence)
        coherence, scale, rows = coherence_of(problem, table, path, sound)
    pairs = replace(pairs, planes=pairs.planes.scaled(scale))
    return Motion(problem, pairs, coherence, rows, path_of(problem, table, pairs, coherence), scale)


def rough_path(problem: MotionProblem, table: CorrelationTable) -> FloatArray:
    """Place frames one after the other by the earlier ones that they resemble, by a phantom's curves.

    Returns
    -------
    ndarray, shape (n, 2)
        Elevational position of each frame's centre, mm, and its slope along x.
    """
    rows = alike_pairs(problem, table)
    planes = problem.fitter.fit(table.correlation[rows], table.inplane[rows, :2])
    rows, planes = rows[planes.determined], planes[planes.determined]
    return settled_path(
        problem.frames,
        table.first[rows],
        table.second[rows],
        planes.coefficients[:, :2],
        planes.covariance[:, :2, :2],
        strangers=strangers(problem, table, np.ones(len(table), dtype=bool)),
        hold=True,
    )


def unsigned_planes(
    problem: MotionProblem,
    table: CorrelationTable,
    path: FloatArray,
    sound: BoolArray,
    coherence: Coherence | None,
) -> SignedPairs:
    """Planes of the pairs near enough on a path to tell a distance; all signs are +1."""
    rows = _near_pairs(problem, table, path[:, 0], sound)
    start = np.abs(path[table.second[rows], 0] - path[table.first[rows], 0])
    return planes_of(problem, table, rows, coherence, start)


def planes_of(
    problem: MotionProblem,
    table: CorrelationTable,
    rows: IntArray,
    coherence: Coherence | None,
    start_mm: FloatArray | None = None,
) -> SignedPairs:
    """Planes of some rows of the table, as far as they are determined; all signs are +1."""
    first, second = table.first[rows], table.second[rows]
    planes = problem.fitter.fit(
        table.correlation[rows], table.inplane[rows, :2], coherence, first, start_mm=start_mm
    )
    return SignedPairs(rows, first, second, planes, np.ones(rows.size))[planes.determined]


def _signed(
    problem: MotionProblem, table: CorrelationTable, sound: BoolArray, pairs: SignedPairs, error: float
) -> SignedPairs:
    """Pairs with the signs that belong together on the likeliest path."""
    if not len(pairs):
        raise InsufficientDataError(
            f"expected frame pairs whose patches determine a plane, got none in {len(table)} pairs of "
            f"{table.correlation.shape[1]} patches: is the image wide enough, and do the curves fit it?"
        )
    path = signed_path(problem, table, sound, pairs, error)
    return pairs.with_signs(pair_signs(path, *pairs.signless))


def signed_path(
    problem: MotionProblem,
    table: CorrelationTable,
    sound: BoolArray,
    pairs: SignedPairs,
    error: float = ADAPTED_ERROR,
    known: FloatArray | None = None,
) -> FloatArray:
    """Likeliest path through unsigned planes, shape (n, 2).

    Parameters
    ----------
    error : float
        Relative, of distances, as for `settled_path`.
    known : ndarray, shape (m, 2), optional
        Path of the first m frames, which stays.
    """
    return settled_path(
        problem.frames,
        *pairs.signless,
        error,
        strangers(problem, table, sound),
        hold=known is not None and len(known) > 0,
        known=known,
    )


def coherence_of(
    problem: MotionProblem, table: CorrelationTable, path: FloatArray, sound: BoolArray
) -> tuple[Coherence, float, RowScales]:
    """Fit what stays of the patches' echoes, and the scale of the path; see `estimate_coherence`."""
    pairs = table.first[sound], table.second[sound], table.correlation[sound]
    return estimate_coherence(
        PatchCorrelations(*pairs, path, problem.curves, problem.patches, problem.fitter.levers)
    )


def slope_evidence(problem: MotionProblem, pairs: SignedPairs, coherence: Coherence | None) -> SlopeEvidence:
    """Weight of the images' own yaw and tilt."""
    expected = float(np.deg2rad(problem.planes.turn_deg_per_mm))
    return weigh_slopes(problem.fitter.design(), pairs.planes, scale_sigma(coherence), expected)


def edges_of(table: CorrelationTable, pairs: SignedPairs, planes: PairPlanes) -> RelativePoses:
    """Relative poses of pairs, from `planes` in place of their own."""
    inplane = table.inplane[pairs.row], table.inplane_covariance[pairs.row]
    return relative_poses_of(pairs.first, pairs.second, *inplane, planes, pairs.sign)


def path_of(
    problem: MotionProblem, table: CorrelationTable, pairs: SignedPairs, coherence: Coherence | None
) -> FloatArray:
    """Position and slopes of every frame on the trajectory of some pairs, shape (n, 3)."""
    slopes = slope_evidence(problem, pairs, coherence)
    edges = edges_of(table, pairs, slopes.applied(pairs.planes))
    poses = solve_trajectory(edges, problem.frames, problem.centre_mm, problem.trajectory).poses
    return elevation_of(poses, problem.centre_mm)


def elevation_of(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Elevational position of the image's centre, mm, and slopes along x and y, shape (n, 3)."""
    return np.column_stack([poses.apply(centre_mm)[:, 2], poses.rotation.as_matrix()[:, 2, :2]])


def alike_pairs(problem: MotionProblem, table: CorrelationTable) -> IntArray:
    """Rows of frames' pairs with earlier frames that they resemble; without any, of their best pair."""
    alike = table.median >= problem.trajectory.least_correlation
    best_first = np.lexsort((-table.median, table.second))
    frame, best = np.unique(table.second[best_first], return_index=True)
    alike[best_first[best[~np.isin(frame, table.second[alike])]]] = True
    return np.flatnonzero(alike)


def _near_pairs(
    problem: MotionProblem, table: CorrelationTable, position_mm: FloatArray, sound: BoolArray
) -> IntArray:
    """Rows of pairs so near that fully developed speckle would keep enough correlation."""
    settings = problem.trajectory
    distance = np.abs(position_mm[table.second] - position_mm[table.first])
    left = problem.fitter.estimator.typical_correlation(distance)
    near = (left >= settings.clear_correlation) & sound
    # Frames without enough of them take those that tell less, and if need be one that tells little.
    pairs = np.bincount(table.second[near], minlength=problem.frames)
    near |= (left >= settings.least_correlation) & sound & (pairs[table.second] < ENOUGH_PAIRS)
    for frame in np.setdiff1d(table.second[sound], table.second[near]):
        rows = np.flatnonzero((table.second == frame) & sound)
        best = rows[np.argmax(left[rows])]
        near[best] = table.median[best] >= LEAST_CORRELATION
    return np.flatnonzero(near)


def strangers(problem: MotionProblem, table: CorrelationTable, sound: BoolArray) -> Strangers:
    """Frames that were compared and do not resemble each other, and how far apart they are.

    Speckle at half the distance at which it keeps `least_correlation` would keep two thirds of it: no
    error of curves makes the one look like the other, and what stays of echoes only adds to it.
    """
    least = problem.trajectory.least_correlation
    far = (table.median < least) & sound
    half = 0.5 * float(problem.fitter.estimator.typical_distance(np.sqrt(least)))
    return Strangers(table.first[far], table.second[far], half)
