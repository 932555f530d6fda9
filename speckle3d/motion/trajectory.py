"""From frame pairs to the poses of all frames: robust least squares on the graph of relative poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.geometry import rotation_from_fixed_angles
from speckle3d.core.relative import RelativePoses
from speckle3d.kernels.graph import PoseGraph, marginals, relax
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.motion.planes import PairPlanes

SETTLED = 1e-7
ROUNDS = 6
HELD_MM, HELD_RAD = 1.0, 0.05
"""How far a probe may go between two frames: 25 mm and 70 degrees in a second at 25 frames."""
FIXED_VARIANCE = 1e-8
"""Of poses that stay, mm^2 and rad^2: far less than any pair's."""
KNOWN_FRAMES = 80
"""Frames whose covariance is computed; those of the others are interpolated."""


def relative_poses_of(
    first: IntArray,
    second: IntArray,
    inplane: FloatArray,
    inplane_covariance: FloatArray,
    planes: PairPlanes,
    sign: FloatArray,
) -> RelativePoses:
    """Relative poses from in-plane motion and signed planes.

    Parameters
    ----------
    first, second : ndarray of int, shape (e,)
    inplane, inplane_covariance : ndarray, shape (e, 3) and (e, 3, 3)
        As of `CorrelationTable`.
    planes : PairPlanes
    sign : ndarray, shape (e,)
    """
    a, b, c = (planes.coefficients * sign[:, None]).T
    yaw = -np.arcsin(np.clip(b, -1, 1))
    tilt = np.arcsin(np.clip(c / np.cos(yaw), -1, 1))
    x, y, roll = inplane.T
    rotation = rotation_from_fixed_angles(roll, yaw, tilt)
    poses = RigidTransform.from_components(np.column_stack([x, y, a]), rotation)
    covariance = np.zeros((len(planes), 6, 6))
    covariance[:, [[0], [1], [5]], [0, 1, 5]] = inplane_covariance + np.diag(INPLANE_FLOOR)
    # (a, b, c) is (z, -yaw, tilt) for small angles.
    order = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    covariance[:, 2:5, 2:5] = order @ planes.covariance @ order.T
    return RelativePoses(first, second, poses, covariance)


INPLANE_FLOOR = (1e-6, 1e-6, 1e-9)
"""Variances of in-plane motion that interpolation leaves, however many patches agree."""


def held(first: IntArray, second: IntArray) -> RelativePoses:
    """Edges that say no more than that a probe does not jump: for frames that no pair joins to others."""
    deviation = np.array([HELD_MM, HELD_MM, HELD_MM, HELD_RAD, HELD_RAD, HELD_RAD])
    poses = RigidTransform.from_translation(np.zeros((first.size, 3)))
    return RelativePoses(first, second, poses, np.tile(np.diag(deviation**2), (first.size, 1, 1)))


def fixed(poses: RigidTransform, centre_mm: FloatArray) -> RelativePoses:
    """Edges from the first of some frames to the others that hold them where they are.

    Parameters
    ----------
    poses : RigidTransform, length n
        ``world_from_image`` of frames 0 to n - 1.
    centre_mm : ndarray, shape (3,)
        The image's centre.
    """
    centre, others = RigidTransform.from_translation(centre_mm), np.arange(1, len(poses))
    relative = centre.inv() * (poses[0].inv() * poses[others]) * centre
    return RelativePoses(
        np.zeros_like(others), others, relative, np.tile(FIXED_VARIANCE * np.eye(6), (others.size, 1, 1))
    )


def joined(*edges: RelativePoses) -> RelativePoses:
    """All of several sets of edges, those without any left out."""
    some = [e for e in edges if len(e)]
    return RelativePoses(
        np.concatenate([e.first for e in some]),
        np.concatenate([e.second for e in some]),
        RigidTransform.concatenate([e.poses for e in some]),
        np.concatenate([e.covariance for e in some]),
    )


@dataclass(frozen=True)
class Trajectory:
    """Poses of all frames, and what the graph alone says of their errors.

    Attributes
    ----------
    poses : RigidTransform, length n
        ``world_from_image``, the first frame being the identity.
    covariance : ndarray, shape (n, 6, 6)
        Of each frame's (x, y, z, tilt, yaw, roll) about the image's centre, in the frame's own axes, as far
        as the pairs' errors are independent of each other.
    """

    poses: RigidTransform
    covariance: FloatArray


def solve_trajectory(
    pairs: RelativePoses,
    frames: int,
    centre_mm: FloatArray,
    settings: TrajectorySettings | None = None,
    with_covariance: bool = False,
) -> Trajectory:
    """Poses of all frames from all pairs: robust Gauss-Newton on the graph of relative poses.

    Frames that no pair joins to earlier ones lie between their neighbours.
    """
    s = settings or TrajectorySettings()
    lone = np.flatnonzero(unjoined(pairs.second, frames))
    after = lone[lone + 1 < frames]
    pairs = joined(pairs, held(np.concatenate([lone - 1, after]), np.concatenate([lone, after + 1])))
    graph, poses = _graph(pairs, frames), _chain(pairs, frames)
    relax(graph, poses, s.huber, ROUNDS, SETTLED)
    covariance = _marginals(graph, poses, s.huber) if with_covariance else np.zeros((frames, 6, 6))
    centre = RigidTransform.from_translation(centre_mm)
    return Trajectory(centre * RigidTransform.from_matrix(poses) * centre.inv(), covariance)


def unjoined(second: IntArray, frames: int) -> BoolArray:
    """Frames after the first that are the second of no pair, shape (n,)."""
    lone = np.ones(frames, dtype=bool)
    lone[0] = False
    lone[second] = False
    return lone


def _chain(pairs: RelativePoses, frames: int) -> FloatArray:
    """Each frame from the pair whose distance is most certain."""
    best = np.zeros(frames, dtype=np.int64)
    backwards = np.lexsort((pairs.covariance[:, 2, 2], pairs.second))[::-1]
    best[pairs.second[backwards]] = backwards  # the last that is written stays
    first, step = pairs.first[best].tolist(), pairs.poses.as_matrix()[best]
    matrices = np.tile(np.eye(4), (frames, 1, 1))
    for frame in range(1, frames):
        matrices[frame] = matrices[first[frame]] @ step[frame]
    return matrices


# The covariance's order is translation, rotation; exponential coordinates' is rotation, translation.
_SWAPPED = np.array([3, 4, 5, 0, 1, 2])


def _graph(pairs: RelativePoses, frames: int) -> PoseGraph:
    """The edges, and the envelope of their normal equations."""
    first, second = (np.ascontiguousarray(each, dtype=np.int64) for each in (pairs.first, pairs.second))
    earliest = np.arange(frames)
    # Frames joined to the first, which is no unknown, reach back no farther for that.
    lower = np.minimum(first, second)
    np.minimum.at(earliest, np.maximum(first, second)[lower > 0], lower[lower > 0])
    begin = np.repeat(6 * (earliest[1:] - 1), 6)
    length = np.arange(begin.size) + 1 - begin
    return PoseGraph(
        first,
        second,
        pairs.poses.inv().as_matrix(),
        np.ascontiguousarray(np.linalg.inv(pairs.covariance)[:, _SWAPPED[:, None], _SWAPPED]),
        begin,
        np.cumsum(length) - length - begin,
        np.empty(int(length.sum())),
    )


def _marginals(graph: PoseGraph, poses: FloatArray, huber: float) -> FloatArray:
    """Covariance of each frame's pose, shape (n, 6, 6), in the order of `RelativePoses`."""
    frames = len(poses)
    known = np.unique(np.linspace(1, frames - 1, min(frames - 1, KNOWN_FRAMES)).astype(np.int64))
    blocks = np.zeros((known.size + 1, 6, 6))
    marginals(graph, poses, huber, known, blocks[1:])
    at, columns = np.concatenate([[0], known]), blocks[:, _SWAPPED[:, None], _SWAPPED].reshape(-1, 36).T
    every = [np.interp(np.arange(frames), at, column) for column in columns]
    return np.stack(every, axis=1).reshape(frames, 6, 6)
