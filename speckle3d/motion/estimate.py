"""Estimate frame poses from correlations, iterating over distances, scale and path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import mirrored
from speckle3d.core.poses import MIRROR, RelativePoses
from speckle3d.core.reconstruction import FramePairs, SharedErrors
from speckle3d.kernels.plane_misfit import EchoModels
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.coherence import Coherence, estimate_coherence
from speckle3d.motion.lens import with_fitted_lens
from speckle3d.motion.planes import (
    LEAST_CORRELATION,
    MotionProblem,
    PairPlanes,
    fully_developed,
    pair_planes,
    patch_distances,
)
from speckle3d.motion.signs import Strangers, likeliest_path, on_path
from speckle3d.motion.trajectory import GraphSolution, edges_of, solve_trajectory
from speckle3d.motion.uncertainty import SlopeWeights, claimed_covariance, weigh_slopes

ROUNDS = 2
"""Rounds in which shares and scale, and the path that they are read from, are estimated in turn; a third
moves lengths by less than 0.2 %."""


@dataclass(frozen=True)
class Motion:
    """Image-based poses of a sweep's frames, with the pairs they were solved from.

    Attributes
    ----------
    problem : MotionProblem
        With the curves as they were read in the end.
    table : CorrelationTable
        Of all pairs.
    pairs : PairPlanes
        On their sides of the first frames, in true distances.
    coherence : Coherence
        Share of structure and gain of every patch, and the scale that `pairs` were multiplied by.
    slopes : SlopeWeights
        Weight of the slopes that the planes have.
    edges : RelativePoses
        From which the poses were solved.
    poses : RigidTransform, length n
        Of either sign of the elevational motion.
    covariance : ndarray, shape (n, 6, 6)
        Of the poses as far as the pairs' errors are independent; see `GraphSolution`.
    """

    problem: MotionProblem
    table: CorrelationTable
    pairs: PairPlanes
    coherence: Coherence
    slopes: SlopeWeights
    edges: RelativePoses
    poses: RigidTransform
    covariance: FloatArray

    @property
    def path(self) -> FloatArray:
        """Elevational position of the image's centre and its slopes along x and y, shape (n, 3)."""
        return elevation_of(self.poses, self.problem.centre_mm)

    @property
    def turn_per_mm(self) -> FloatArray:
        """Mean slopes along x and y per distance, shape (2,), rad/mm."""
        z, *slopes = np.diff(self.path, axis=0).T
        return np.asarray(np.stack(slopes) @ z / max(z @ z, 1e-12))

    def claims(self, curves_sigma: float) -> tuple[SharedErrors, FloatArray]:
        """Errors that all frames share, and the covariance of every pose; see `claimed_covariance`.

        Parameters
        ----------
        curves_sigma : float
            Relative standard deviation of all distances by the curves' mismatch with probe and tissue.
        """
        coherence, slopes, problem = self.coherence, self.slopes, self.problem
        # Without a response to tilt the focus may be anywhere in the image. A turn about another depth than
        # is taken moves the image's centre along.
        focus_sigma_mm = 0.0 if problem.curves.tilt else np.std(problem.patches.depth_mm)
        by_focus = focus_sigma_mm * np.hypot(self.turn_per_mm, slopes.deviation_per_mm)
        by_turns = slopes.lever_mm * slopes.deviation_per_mm
        scale_sigma = np.linalg.norm([coherence.scale_sigma, *by_turns, by_focus[1]])
        # The foci of a fan lie on an arc of another radius, by which it is seen.
        by_focus *= np.std(np.sin(problem.patches.angle_rad)) / problem.width_mm
        turn_sigma = np.hypot(slopes.deviation_per_mm, by_focus)
        shared = SharedErrors(float(scale_sigma), curves_sigma, turn_sigma)
        return shared, claimed_covariance(
            self.poses, self.covariance, problem.centre_mm, shared, float(coherence.share.mean())
        )

    def mirrored(self) -> Motion:
        """The motion with the opposite elevational sign."""
        return replace(
            self,
            pairs=self.pairs.scaled(-1.0),
            edges=self.edges.mirrored(),
            poses=mirrored(self.poses),
            covariance=MIRROR @ self.covariance @ MIRROR,
        )


def estimate_motion(problem: MotionProblem, table: CorrelationTable) -> Motion:
    """Estimate the motion of a sweep's frames; with curves from a data sheet, the lens before it.

    The lens is fitted to what depths disagree on in a first estimate, and all is read again with it.

    Parameters
    ----------
    table : CorrelationTable
        Of pairs both of whose frames are to be trusted.

    Raises
    ------
    InsufficientDataError
        If no pair determines a plane.
    """
    curves = problem.curves
    if curves.origin == "data sheet":
        # Tilt bends rows as a lens does: it is left out until the lens is known.
        first = _alternate(replace(problem, curves=replace(curves, tilt=None)), table)
        if first.coherence.rows:
            problem = replace(problem, curves=with_fitted_lens(curves, first.coherence.rows))
    return _alternate(problem, table)


def _alternate(problem: MotionProblem, table: CorrelationTable) -> Motion:
    """Estimate shares of structure, scale of distances and path.

    All that iterates does so here. Distances and their scale need the path, the path needs distances: both
    are repeated `ROUNDS` times.
    """
    rows = alike_pairs(problem, table, table.median)
    # A fan's columns show a turn, which patches' gains would take for their own.
    is_fan = problem.patches.step_rad > 0
    first = replace(problem, curves=replace(problem.curves, tilt=None)) if is_fan else problem
    pairs, path = _signed_planes(first, table, rows, fully_developed(table.correlation.shape[1]))
    path = path @ np.eye(2, 3)
    if is_fan:
        path = elevation_of(solve_planes(first, table, pairs)[1].poses, problem.centre_mm)
    coherence = estimate_coherence(problem, table, path)
    for _ in range(ROUNDS):
        apart_mm = coherence.scale * np.abs(path[table.second, 0] - path[table.first, 0])
        rows = alike_pairs(problem, table, problem.typical_correlation(apart_mm))
        pairs, _ = _signed_planes(problem, table, rows, coherence.models(table.first[rows]))
        slopes = weigh_slopes(pairs, coherence.false_turn, problem.planes, path)
        _, trajectory = solve_planes(problem, table, slopes.applied(pairs))
        path = elevation_of(trajectory.poses, problem.centre_mm)
        coherence = estimate_coherence(problem, table, path)
    slopes = weigh_slopes(pairs, coherence.false_turn, problem.planes, path)
    pairs = pairs.scaled(coherence.scale)
    edges, trajectory = solve_planes(problem, table, slopes.applied(pairs))
    return Motion(problem, table, pairs, coherence, slopes, edges, trajectory.poses, trajectory.covariance)


def solve_planes(
    problem: MotionProblem, table: CorrelationTable, pairs: PairPlanes
) -> tuple[RelativePoses, GraphSolution]:
    """Trajectory of some pairs, and the edges that it is solved from."""
    edges = edges_of(table, pairs)
    return edges, solve_trajectory(
        edges, problem.frames, problem.centre_mm, problem.trajectory.huber, problem.repeats
    )


def alike_pairs(problem: MotionProblem, table: CorrelationTable, correlation: FloatArray) -> IntArray:
    """Rows of correlated pairs; for frames without any, of their best pair. All tell a little.

    Parameters
    ----------
    correlation : ndarray, shape (e,)
        As measured, or of fully developed speckle as far apart.
    """
    _, begin, count = np.unique(table.second, return_index=True, return_counts=True)
    is_used = correlation >= np.repeat(np.fmax.reduceat(correlation, begin), count)
    is_used |= correlation >= problem.trajectory.least_correlation
    return np.flatnonzero(is_used & (table.median >= LEAST_CORRELATION))


def _signed_planes(
    problem: MotionProblem,
    table: CorrelationTable,
    rows: IntArray,
    models: EchoModels,
) -> tuple[PairPlanes, FloatArray]:
    """Planes of some pairs, with the signs of the likeliest path through them, and that path."""
    planes, firm = pair_planes(problem, table, rows, models)
    planes = planes[firm]
    if not len(planes):
        raise InsufficientDataError(
            f"expected frame pairs whose patches determine a plane, got none in {len(table)} pairs of "
            f"{table.correlation.shape[1]} patches: is the image wide enough, and do the curves fit it?"
        )
    path = likeliest_path(planes, problem.frames, strangers(problem, table))
    return on_path(planes, path), path


def strangers(problem: MotionProblem, table: CorrelationTable) -> Strangers:
    """Compared frame pairs without correlation, with their least distance.

    Speckle at half the distance at which it keeps `least_correlation` would keep two thirds of it: no
    error of curves makes the one look like the other, and what stays of echoes only adds to it.
    """
    least = problem.trajectory.least_correlation
    far = table.median < least
    return Strangers(
        table.first[far],
        table.second[far],
        float(problem.typical_distance(np.sqrt(least))) / 2,
        problem.width_mm,
    )


def elevation_of(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Elevational position of the image's centre, mm, and slopes along x and y, shape (n, 3)."""
    return np.column_stack([poses.apply(centre_mm)[:, 2], poses.rotation.as_matrix()[:, 2, :2]])


def frame_pairs(motion: Motion, used: BoolArray, length_sigma: float) -> FramePairs:
    """Pairs as the reconstruction file holds them; deviations include that of the scale."""
    pairs, edges, problem, coherence = motion.pairs, motion.edges, motion.problem, motion.coherence
    centre = RigidTransform.from_translation(problem.centre_mm)
    correlation, models = motion.table.correlation[pairs.row], coherence.models(pairs.first)
    distance, sigma = (coherence.scale * v for v in patch_distances(problem, correlation, models))
    return FramePairs(
        first=edges.first,
        second=edges.second,
        first_from_second=(centre * edges.poses * centre.inv()).as_matrix(),
        covariance=edges.covariance,
        distance_mm=distance.astype(np.float32),
        sigma_mm=np.hypot(sigma, length_sigma * distance).astype(np.float32),
        used=used,
        patch_centre_mm=problem.patches.centre_mm,
    )
