"""From a sweep's correlations to the poses of its frames and what these claim: all that images tell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import EchoSpectra
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.reconstruction import FramePairs, SharedErrors
from speckle3d.core.relative import MIRROR, RelativePoses
from speckle3d.kernels.plane_misfit import EchoModels
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.attenuation import Attenuation, estimate_attenuation
from speckle3d.motion.coherence import CURVES_SIGMA, Coherence, RowScales, estimate_coherence
from speckle3d.motion.lens import with_fitted_lens
from speckle3d.motion.planes import (
    LEAST_CORRELATION,
    MotionProblem,
    PairPlanes,
    pair_planes,
    patch_distances,
)
from speckle3d.motion.signs import ADAPTED_ERROR, PLAIN_ERROR, Strangers, likeliest_path, on_path
from speckle3d.motion.subset import consistent_planes
from speckle3d.motion.trajectory import edges_of, solve_trajectory, unjoined
from speckle3d.motion.uncertainty import SlopeWeights, claimed_covariance, weigh_slopes

ROUNDS = 2
"""Rounds in which shares and scale, and the path that they are read from, are estimated in turn; a third
moves lengths by less than 0.2 %."""
LENS_ROUNDS = 4
"""Fits of a data sheet's lens: a path read with a wrong lens bends the rows otherwise than the right one."""
ENOUGH_PAIRS = 3
"""Pairs to earlier frames from which a frame needs none that tells less."""
PAIRS_AT_ONCE = 1024
"""Pairs whose distances are held at once."""


@dataclass(frozen=True)
class Motion:
    """Signed planes of a sweep's frame pairs, and what they were read with.

    Attributes
    ----------
    problem : MotionProblem
        With the curves as they were read in the end.
    pairs : PairPlanes
        On their sides of the first frames.
    coherence : Coherence or None
        Share of structure and gain of every patch; None if not adapted to.
    rows : RowScales or None
        Scales that rows of patches ask for; None if not adapted to.
    slopes : SlopeWeights
        Weight of the slopes that the planes have.
    path : ndarray, shape (n, 3)
        Elevational position of the image's centre and slopes along x and y of every frame.
    scale : float
        Of all distances over those that planes fitted with `coherence` have; in `pairs` and `path`.
    """

    problem: MotionProblem
    pairs: PairPlanes
    coherence: Coherence | None
    rows: RowScales | None
    slopes: SlopeWeights
    path: FloatArray
    scale: float = 1.0

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale of all distances; the curves' own without adaptation."""
        return CURVES_SIGMA if self.coherence is None else self.coherence.scale_sigma

    def models(self, frame: IntArray) -> EchoModels | None:
        """Echo models of pairs about frames of shape (e,); None if not adapted to."""
        return None if self.coherence is None else self.coherence.models(frame)


@dataclass(frozen=True)
class ImageMotion:
    """Poses of all frames by the images, of either sign of the elevational motion.

    Attributes
    ----------
    motion : Motion
    table : CorrelationTable
        Of its pairs.
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
) -> ImageMotion:
    """Estimate attenuation, distances, scale and path; solve the poses; say what they claim.

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

    Raises
    ------
    InsufficientDataError
        If no pair determines a plane.
    """
    attenuation = estimate_attenuation(problem.curves, spectra)
    curves = attenuation.applied(problem.curves)
    sound = ~bad[table.first] & ~bad[table.second]
    motion = estimate_motion(replace(problem, curves=curves), table, sound)
    edges = edges_of(table, motion.slopes.applied(motion.pairs))
    solved = solve_trajectory(edges, problem.frames, problem.centre_mm, problem.trajectory.huber, True)
    curves_sigma = motion.problem.curves.mismatch(same_probe, attenuation.log_length_sigma)
    shared = SharedErrors(motion.scale_sigma, curves_sigma, motion.slopes.deviation_per_mm)
    structure = 0.0 if motion.coherence is None else float(motion.coherence.share.mean())
    covariance = claimed_covariance(solved.poses, solved.covariance, problem.centre_mm, shared, structure)
    unplaced = unjoined(motion.pairs.second, problem.frames)
    return ImageMotion(motion, table, attenuation, edges, solved.poses, covariance, shared, unplaced)


def estimate_motion(problem: MotionProblem, table: CorrelationTable, sound: BoolArray) -> Motion:
    """Estimate shares of structure, the scale of distances and the path, each from the others, in turn.

    All that iterates does so here. Distances and their scale need the path, the path needs distances: both
    are repeated `ROUNDS` times. For curves from a data sheet the lens is fitted to what depths then disagree
    on, and all is read again with it.

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
    alike, determined = pair_planes(problem, table, alike_pairs(problem, table))
    path = likeliest_path(alike[determined], problem.frames, PLAIN_ERROR, strangers(problem, table))
    if not problem.adapt:
        pairs = _signed_planes(problem, table, sound, path, None)
        slopes = weigh_slopes(pairs, CURVES_SIGMA, problem.planes)
        return Motion(problem, pairs, None, None, slopes, _path_of(problem, table, pairs, slopes))
    nominal, tilt = problem.curves.nominal, problem.curves.tilt
    fitted = problem.curves.origin == "data sheet" and nominal is not None
    if fitted:
        # Tilt bends rows as a lens does: it is left out until the lens is known.
        problem = replace(problem, curves=replace(problem.curves, tilt=None))
    for lens_round in range(LENS_ROUNDS + 1 if fitted else 1):
        coherence, scale, rows = estimate_coherence(problem, table, sound, path)
        for _ in range(ROUNDS):
            pairs = _signed_planes(problem, table, sound, path * scale, coherence)
            slopes = weigh_slopes(pairs, coherence.scale_sigma, problem.planes)
            path = _path_of(problem, table, pairs, slopes)
            coherence, scale, rows = estimate_coherence(problem, table, sound, path)
        if nominal is not None and lens_round < LENS_ROUNDS and fitted:
            curves, path = with_fitted_lens(problem.curves, rows, nominal), path * scale
            tilt_known = tilt if lens_round == LENS_ROUNDS - 1 else None
            problem = replace(problem, curves=replace(curves, tilt=tilt_known))
    slopes, path = weigh_slopes(pairs, coherence.scale_sigma, problem.planes), path * [scale, 1.0, 1.0]
    return Motion(problem, pairs.scaled(scale), coherence, rows, slopes, path, scale)


def alike_pairs(problem: MotionProblem, table: CorrelationTable) -> IntArray:
    """Rows of frames' pairs with earlier frames that they resemble; without any, of their best pair."""
    alike = table.median >= problem.trajectory.least_correlation
    best_first = np.lexsort((-table.median, table.second))
    frame, best = np.unique(table.second[best_first], return_index=True)
    alike[best_first[best[~np.isin(frame, table.second[alike])]]] = True
    return np.flatnonzero(alike)


def _signed_planes(
    problem: MotionProblem,
    table: CorrelationTable,
    sound: BoolArray,
    path: FloatArray,
    coherence: Coherence | None,
) -> PairPlanes:
    """Planes of the pairs near enough on a path, with the signs of the likeliest path through them."""
    rows = _near_pairs(problem, table, path[:, 0], sound)
    first, second = table.first[rows], table.second[rows]
    models = None if coherence is None else coherence.models(first)
    planes, determined = pair_planes(problem, table, rows, models, np.abs(path[second, 0] - path[first, 0]))
    planes = planes[determined]
    if not len(planes):
        raise InsufficientDataError(
            f"expected frame pairs whose patches determine a plane, got none in {len(table)} pairs of "
            f"{table.correlation.shape[1]} patches: is the image wide enough, and do the curves fit it?"
        )
    error = PLAIN_ERROR if coherence is None else ADAPTED_ERROR
    apart = strangers(problem, table.where(sound))
    return on_path(planes, likeliest_path(planes, problem.frames, error, apart))


def strangers(problem: MotionProblem, table: CorrelationTable) -> Strangers:
    """Frames that were compared and do not resemble each other, and how far apart they are.

    Speckle at half the distance at which it keeps `least_correlation` would keep two thirds of it: no
    error of curves makes the one look like the other, and what stays of echoes only adds to it.
    """
    least = problem.trajectory.least_correlation
    far = table.median < least
    return Strangers(table.first[far], table.second[far], float(problem.typical_distance(np.sqrt(least))) / 2)


def _near_pairs(
    problem: MotionProblem, table: CorrelationTable, position_mm: FloatArray, sound: BoolArray
) -> IntArray:
    """Rows of pairs so near that fully developed speckle would keep enough correlation."""
    settings = problem.trajectory
    left = problem.typical_correlation(np.abs(position_mm[table.second] - position_mm[table.first]))
    near = (left >= settings.clear_correlation) & sound
    # Frames without enough of them take those that tell less, and if need be one that tells little.
    pairs = np.bincount(table.second[near], minlength=problem.frames)
    near |= (left >= settings.least_correlation) & sound & (pairs[table.second] < ENOUGH_PAIRS)
    for frame in np.setdiff1d(table.second[sound], table.second[near]):
        rows = np.flatnonzero((table.second == frame) & sound)
        best = rows[np.argmax(left[rows])]
        near[best] = table.median[best] >= LEAST_CORRELATION
    return np.flatnonzero(near)


def _path_of(
    problem: MotionProblem, table: CorrelationTable, pairs: PairPlanes, slopes: SlopeWeights
) -> FloatArray:
    """Position and slopes of every frame on the trajectory of some pairs, shape (n, 3)."""
    edges = edges_of(table, slopes.applied(pairs))
    solved = solve_trajectory(edges, problem.frames, problem.centre_mm, problem.trajectory.huber)
    return elevation_of(solved.poses, problem.centre_mm)


def elevation_of(poses: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Elevational position of the image's centre, mm, and slopes along x and y, shape (n, 3)."""
    return np.column_stack([poses.apply(centre_mm)[:, 2], poses.rotation.as_matrix()[:, 2, :2]])


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
        return None, motion.pairs.used
    models = motion.models(motion.pairs.first)
    planes = consistent_planes(
        motion.problem, motion.pairs, solution.table, models, motion.scale, sensed, direction
    )
    problem, edges = motion.problem, edges_of(solution.table, planes)
    solved = solve_trajectory(edges, problem.frames, problem.centre_mm, problem.trajectory.huber)
    return solved.poses, planes.used


def frame_pairs(solution: ImageMotion, used: BoolArray, direction: int) -> Iterator[FramePairs]:
    """Yield the pairs for the reconstruction file, some at a time; deviations include that of the scale."""
    motion, edges = solution.motion, solution.edges
    pairs, problem = motion.pairs, motion.problem
    centre = RigidTransform.from_translation(problem.centre_mm)
    flip, turn = np.diag([1.0, 1.0, direction, 1.0]), MIRROR if direction < 0 else np.eye(6)
    for start in range(0, max(len(pairs), 1), PAIRS_AT_ONCE):
        some = slice(start, start + PAIRS_AT_ONCE)
        models = motion.models(pairs.first[some])
        correlation = solution.table.correlation[pairs.row[some]]
        distance, sigma = (motion.scale * v for v in patch_distances(problem, correlation, models))
        yield FramePairs(
            first=edges.first[some],
            second=edges.second[some],
            first_from_second=flip @ (centre * edges.poses[some] * centre.inv()).as_matrix() @ flip,
            covariance=turn @ edges.covariance[some] @ turn,
            distance_mm=distance.astype(np.float32),
            sigma_mm=np.hypot(sigma, solution.length_sigma * distance).astype(np.float32),
            used=used[some],
            patch_centre_mm=problem.patches.centre_mm,
        )
