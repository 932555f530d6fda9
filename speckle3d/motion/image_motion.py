"""From a sweep's correlations to the poses of its frames and what these claim: all that images tell."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.curves import EchoSpectra
from speckle3d.core.reconstruction import FramePairs, SharedErrors
from speckle3d.core.relative import MIRROR, RelativePoses
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.attenuation import Attenuation, estimate_attenuation
from speckle3d.motion.coherence import scale_sigma
from speckle3d.motion.estimate import Motion, MotionProblem, edges_of, estimate_motion
from speckle3d.motion.revisits import find_returns, tie_returns
from speckle3d.motion.subset import consistent_planes
from speckle3d.motion.trajectory import solve_trajectory, unjoined
from speckle3d.motion.uncertainty import claimed_covariance

PAIRS_AT_ONCE = 1024
"""Pairs whose distances are held at once."""


@dataclass(frozen=True)
class ImageMotion:
    """Poses of all frames by the images, of either sign of the elevational motion.

    Attributes
    ----------
    motion : Motion
        Signed planes of the frame pairs, ties between visits of the same tissue among them.
    table : CorrelationTable
        Of these pairs.
    attenuation : Attenuation
        Of the tissue over the curves' phantom, by the echoes' spectrum.
    edges : RelativePoses
        From which the poses were solved.
    poses : RigidTransform, length n
    covariance : ndarray, shape (n, 6, 6)
        See `speckle3d.motion.uncertainty`; what the curves' mismatch does is in it.
    shared : SharedErrors
        What of it all frames have in common.
    unplaced : ndarray of bool, shape (n,)
        Frames that no pair joins to earlier ones.
    """

    motion: Motion
    table: CorrelationTable
    attenuation: Attenuation
    edges: RelativePoses
    poses: RigidTransform
    covariance: FloatArray
    shared: SharedErrors
    unplaced: BoolArray

    @property
    def length_sigma(self) -> float:
        """Relative standard deviation of the scale of distances, which all pairs share."""
        return float(np.hypot(self.shared.scale_sigma, self.shared.curves_sigma))


def estimate_image_motion(
    problem: MotionProblem,
    table: CorrelationTable,
    spectra: EchoSpectra | None,
    bad: BoolArray,
    same_probe: bool,
    match: Callable[[Sequence[tuple[int, int]]], CorrelationTable],
) -> ImageMotion:
    """Estimate attenuation, distances, scale and path; tie visits of the same tissue; solve the poses.

    Parameters
    ----------
    problem : MotionProblem
        With the curves as measured.
    table : CorrelationTable
        Of the sweep's frames.
    spectra : EchoSpectra or None
        Of its echoes.
    bad : ndarray of bool, shape (n,)
        Frames whose pairs are not to be trusted.
    same_probe : bool
        Whether the curves were measured with the very probe of the sweep.
    match : callable
        Matches chosen frame pairs.

    Raises
    ------
    InsufficientDataError
        If no pair determines a plane.
    """
    attenuation = estimate_attenuation(problem.curves, spectra)
    problem = problem.with_curves(attenuation.applied(problem.curves))
    motion = estimate_motion(problem, table, ~bad[table.first] & ~bad[table.second])
    unplaced = unjoined(motion.pairs.second, problem.frames)

    # The path shows which frames of different visits see the same tissue.
    returns = find_returns(motion.path[:, 0], problem.trajectory.revisit_mm)
    table = table.followed_by(match([pair for each in returns for pair in each.pairs()]))
    ties = tie_returns(returns, motion, table)
    sound = ~bad & ~unplaced
    motion = replace(motion, pairs=motion.pairs.and_also(ties[sound[ties.first] & sound[ties.second]]))

    slopes, curves = motion.slopes, motion.problem.curves
    edges = edges_of(table, motion.pairs, slopes.applied(motion.pairs.planes))
    solved = solve_trajectory(edges, problem.frames, problem.centre_mm, problem.trajectory, True)
    shared = SharedErrors(
        scale_sigma(motion.coherence),
        curves.mismatch(same_probe, attenuation.log_length_sigma),
        slopes.deviation_per_mm,
    )
    covariance = claimed_covariance(
        solved.poses, solved.covariance, problem.centre_mm, shared, motion.structure
    )
    return ImageMotion(motion, table, attenuation, edges, solved.poses, covariance, shared, unplaced)


def consistent_poses(
    solution: ImageMotion, sensed: Rotation | None, direction: int
) -> tuple[RigidTransform | None, BoolArray]:
    """Poses from the orientation-consistent patches (None without a sensor), and each pair's patches used.

    Parameters
    ----------
    sensed : Rotation, length n, or None
        Orientation of every frame.
    direction : int
        Sign of the elevational motion.
    """
    motion = solution.motion
    if sensed is None:
        return None, motion.pairs.planes.used
    planes = consistent_planes(motion, solution.table, sensed, direction)
    edges, problem = edges_of(solution.table, motion.pairs, planes), motion.problem
    solved = solve_trajectory(edges, problem.frames, problem.centre_mm, problem.trajectory)
    return solved.poses, planes.used


def frame_pairs(solution: ImageMotion, used: BoolArray, direction: int) -> Iterator[FramePairs]:
    """Yield the pairs for the reconstruction file, some at a time; deviations include that of the scale."""
    motion, edges, problem = solution.motion, solution.edges, solution.motion.problem
    pairs = motion.pairs
    centre = RigidTransform.from_translation(problem.centre_mm)
    flip, turn = np.diag([1.0, 1.0, direction, 1.0]), MIRROR if direction < 0 else np.eye(6)
    for start in range(0, max(len(pairs), 1), PAIRS_AT_ONCE):
        some = slice(start, start + PAIRS_AT_ONCE)
        correlation = solution.table.correlation[pairs.row[some]]
        d = problem.fitter.distances(correlation, motion.coherence, pairs.first[some]).scaled(motion.scale)
        yield FramePairs(
            first=edges.first[some],
            second=edges.second[some],
            first_from_second=flip @ (centre * edges.poses[some] * centre.inv()).as_matrix() @ flip,
            covariance=turn @ edges.covariance[some] @ turn,
            distance_mm=d.distance_mm.astype(np.float32),
            sigma_mm=np.hypot(d.sigma_mm, solution.length_sigma * d.distance_mm).astype(np.float32),
            used=used[some],
            patch_centre_mm=problem.patches.centre_mm,
        )
