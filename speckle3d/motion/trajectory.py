"""From frame pairs to the poses of all frames: robust least squares on the graph of relative poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import adjoint, rotation_from_fixed_angles
from speckle3d.core.relative import RelativePoses
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.motion.planes import PairPlanes

SETTLED = 1e-7
ROUNDS = 6
HELD_MM, HELD_RAD = 1.0, 0.05
"""How far a probe may go between two frames: 25 mm and 70 degrees in a second at 25 frames."""
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

    Raises
    ------
    InsufficientDataError
        If a frame is joined to no earlier one.
    """
    s = settings or TrajectorySettings()
    _require_connected(pairs.second, frames)
    whitening = np.linalg.cholesky(np.linalg.inv(pairs.covariance)).transpose(0, 2, 1)
    poses = _chain(pairs, frames, s.join == "chain")
    for _ in range(ROUNDS if s.join == "graph" else 0):
        normal, gradient = _normal_equations(poses, pairs, whitening, s.huber)
        step = np.concatenate([np.zeros((1, 6)), splu(normal).solve(-gradient).reshape(-1, 6)])
        poses = poses * RigidTransform.from_exp_coords(step)
        if np.abs(step).max() < SETTLED:
            break
    covariance = np.zeros((frames, 6, 6))
    if with_covariance:
        normal, _ = _normal_equations(poses, pairs, whitening, s.huber)
        covariance = _marginals(normal, frames)
    centre = RigidTransform.from_translation(centre_mm)
    return Trajectory(centre * poses * centre.inv(), covariance)


def _require_connected(second: IntArray, frames: int) -> None:
    joined = np.zeros(frames, dtype=bool)
    joined[0] = True
    joined[second] = True
    if not joined.all():
        lost = int(np.flatnonzero(~joined)[0])
        raise InsufficientDataError(
            f"frame {lost}: expected speckle in common with an earlier frame, found none "
            f"({int((~joined).sum())} of {frames} frames so)"
        )


def _chain(pairs: RelativePoses, frames: int, relative: bool) -> RigidTransform:
    """Each frame from the pair whose distance is most certain, absolutely or relative to its size."""
    doubt = pairs.covariance[:, 2, 2]
    if relative:
        doubt = doubt / np.maximum(pairs.poses.translation[:, 2] ** 2, 1e-6)
    best: dict[int, int] = {}
    for row, second in enumerate(pairs.second.tolist()):
        if second not in best or doubt[row] < doubt[best[second]]:
            best[second] = row
    step = pairs.poses.as_matrix()
    matrices = np.tile(np.eye(4), (frames, 1, 1))
    for frame in range(1, frames):
        matrices[frame] = matrices[pairs.first[best[frame]]] @ step[best[frame]]
    return RigidTransform.from_matrix(matrices)


def _normal_equations(
    poses: RigidTransform, pairs: RelativePoses, whitening: FloatArray, huber: float
) -> tuple[sparse.csc_matrix, FloatArray]:
    """For right increments of every pose but the first, each a rotation and a translation."""
    first, second = pairs.first, pairs.second
    relative = poses[first].inv() * poses[second]
    error = (pairs.poses.inv() * relative).as_exp_coords()
    # The covariance's order is translation, rotation; exponential coordinates' is rotation, translation.
    swap = [3, 4, 5, 0, 1, 2]
    w = whitening[:, :, swap]
    r = np.einsum("eij,ej->ei", w, error)
    size = np.linalg.norm(r, axis=1) / np.sqrt(6)
    w = w * np.sqrt(np.minimum(1.0, huber / np.maximum(size, 1e-9)))[:, None, None]
    r = np.einsum("eij,ej->ei", w, error)
    j_second = w
    j_first = -w @ adjoint(relative.inv())
    edges, n = first.size, len(poses)
    rows = (6 * np.arange(edges)[:, None, None] + np.arange(6)[:, None]) + np.zeros((1, 1, 6), dtype=int)
    column = np.arange(6)[None, None, :] + np.zeros((1, 6, 1), dtype=int)
    jacobian = sparse.csr_matrix(
        (
            np.concatenate([j_first.ravel(), j_second.ravel()]),
            (
                np.concatenate([rows.ravel(), rows.ravel()]),
                np.concatenate(
                    [
                        (6 * first[:, None, None] + column).ravel(),
                        (6 * second[:, None, None] + column).ravel(),
                    ]
                ),
            ),
        ),
        shape=(6 * edges, 6 * n),
    )[:, 6:]
    normal = (jacobian.T @ jacobian + 1e-9 * sparse.identity(6 * (n - 1))).tocsc()
    return normal, np.asarray(jacobian.T @ r.ravel())


def _marginals(normal: sparse.csc_matrix, frames: int) -> FloatArray:
    """Covariance of each frame's pose, shape (n, 6, 6), in the order of `RelativePoses`."""
    solver = splu(normal)
    known = np.unique(np.linspace(1, frames - 1, min(frames - 1, KNOWN_FRAMES)).astype(int))
    blocks = np.zeros((known.size + 1, 36))
    for k, frame in enumerate(known, start=1):
        rows = 6 * (frame - 1) + np.arange(6)
        unit = np.zeros((normal.shape[0], 6))
        unit[rows, np.arange(6)] = 1.0
        block = solver.solve(unit)[rows]
        blocks[k] = (block + block.T)[np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])].ravel() / 2
    at = np.concatenate([[0], known])
    every = [np.interp(np.arange(frames), at, column) for column in blocks.T]
    return np.stack(every, axis=1).reshape(frames, 6, 6)
