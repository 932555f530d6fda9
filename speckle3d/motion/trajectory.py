"""Poses of all frames by robust least squares on the graph of relative poses."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline
from scipy.sparse import bsr_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.geometry import rotation_from_fixed_angles, skew
from speckle3d.core.leastsquares import huber_weights
from speckle3d.core.poses import ERROR_STEPS, HELD, RelativePoses
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.planes import PairPlanes

ROUNDS = 4
"""Of Gauss-Newton; the next has steps below 1e-4 mm and rad."""
SAME = 1e-9
"""Variance of places and turns between images that are the same, mm^2 and rad^2: no graph can weigh 0."""


@dataclass(frozen=True)
class GraphSolution:
    """Poses of all frames with the graph's covariance.

    Attributes
    ----------
    poses : RigidTransform, length n
        ``world_from_image``, the first frame being the identity.
    normal : SuperLU
        Factors of the normal equations for twists of all frames but the first.
    """

    poses: RigidTransform
    normal: Any

    @property
    def covariance(self) -> FloatArray:
        """Covariance of each pose (x, y, z, tilt, yaw, roll) in its frame's axes, shape (n, 6, 6).

        As far as the pairs' errors are independent of each other. Of frames between those computed it is
        interpolated.
        """
        frames = len(self.poses)
        frame_numbers = np.unique(np.linspace(1, frames - 1, min(frames - 1, ERROR_STEPS)).astype(int))
        blocks = [np.zeros((6, 6))]
        for frame in frame_numbers:
            rows = slice(6 * frame - 6, 6 * frame)
            unit = np.zeros((6 * (frames - 1), 6))
            unit[rows] = np.eye(6)
            blocks.append(self.normal.solve(unit)[rows])
        by_frame = make_interp_spline(np.append(0, frame_numbers), np.array(blocks), k=1)
        return np.asarray(by_frame(np.arange(frames)))


def solve_trajectory(
    pairs: RelativePoses,
    frames: int,
    centre_mm: FloatArray,
    huber: float = 2.0,
    repeats: npt.ArrayLike = (),
) -> GraphSolution:
    """Poses of all frames from all pairs: robust Gauss-Newton on the graph of relative poses.

    Frames that no pair joins to earlier ones lie between their neighbours.

    Parameters
    ----------
    huber : float
        Standard deviations at which a pair begins to lose weight.
    repeats : array_like of int
        Frames with the image of the one before, in no pair; they are where that is.
    """
    pairs = _with_loose_edges(pairs, frames, np.isin(np.arange(frames), repeats))
    poses, root = RigidTransform.identity(frames), np.linalg.cholesky(np.linalg.inv(pairs.covariance))
    for number in range(ROUNDS):
        # From nowhere, all pairs are far off alike.
        normal, gradient = _normal(pairs, root, poses, huber if number else np.finfo(float).max)
        step = np.zeros((frames, 6))
        step[1:] = -normal.solve(gradient).reshape(-1, 6)
        # Exponential coordinates have the rotation first.
        poses = poses * RigidTransform.from_exp_coords(np.roll(step, 3, axis=1))
    centre = RigidTransform.from_translation(centre_mm)
    return GraphSolution(centre * poses * centre.inv(), normal)


def _normal(
    pairs: RelativePoses, root: FloatArray, poses: RigidTransform, huber: float
) -> tuple[Any, FloatArray]:
    """Factors of the normal equations for twists of all frames but the first, and the cost's gradient.

    Parameters
    ----------
    root : ndarray, shape (e, 6, 6)
        Lower triangular roots of the pairs' information.
    """
    relative = poses[pairs.first].inv() * poses[pairs.second]
    turn = relative.rotation.inv().as_matrix()
    carried = np.zeros((len(pairs), 6, 6))
    carried[:, :3, :3] = carried[:, 3:, 3:] = turn
    carried[:, :3, 3:] = -turn @ skew(relative.translation)
    whiten = root.transpose(0, 2, 1)
    error = np.roll((pairs.poses.inv() * relative).as_exp_coords(), 3, axis=1)[:, :, None]
    size = np.sqrt(((whiten @ error) ** 2).mean(axis=(1, 2)))
    whiten = np.sqrt(huber_weights(size, huber))[:, None, None] * whiten
    blocks = np.stack([-whiten @ carried, whiten], axis=1).reshape(-1, 6, 6)
    columns = np.column_stack([pairs.first, pairs.second]).ravel()
    shape = 6 * len(pairs), 6 * len(poses)
    every = bsr_array((blocks, columns, np.arange(0, columns.size + 1, 2)), shape=shape)
    jacobian = every.tocsc()[:, 6:]
    normal = (jacobian.T @ jacobian).tocsc()
    factors = splu(normal, "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True})
    return factors, jacobian.T @ (whiten @ error).ravel()


def loose_frames(second: IntArray, frames: int) -> BoolArray:
    """Frames after the first that are the second of no pair, shape (n,)."""
    return ~np.isin(np.arange(frames), np.append(0, second))


def _with_loose_edges(pairs: RelativePoses, frames: int, is_repeat: BoolArray) -> RelativePoses:
    """Join loose frames to their neighbours by edges of large covariance, repeats to what they repeat."""
    loose = loose_frames(pairs.second, frames)
    second = np.flatnonzero(loose | np.append(False, loose[:-1]))
    latest_image = np.maximum.accumulate(np.where(is_repeat, 0, np.arange(frames)))
    variance = (second - latest_image[second - 1])[:, None] * HELD**2
    variance[is_repeat[second]] = SAME
    return RelativePoses(
        np.concatenate([pairs.first, second - 1]),
        np.concatenate([pairs.second, second]),
        RigidTransform.concatenate([pairs.poses, RigidTransform.identity(second.size)]),
        np.concatenate([pairs.covariance, variance[:, :, None] * np.eye(6)]),
    )


def edges_of(table: CorrelationTable, planes: PairPlanes) -> RelativePoses:
    """Relative poses of frame pairs from their in-plane motion and signed planes."""
    a, b, c = planes.coefficients.T
    yaw = -np.arcsin(np.clip(b, -1, 1))
    tilt = np.arcsin(np.clip(c / np.cos(yaw), -1, 1))
    x, y, roll = table.inplane[planes.row].T
    rotation = rotation_from_fixed_angles(roll, yaw, tilt)
    poses = RigidTransform.from_components(np.column_stack([x, y, a]), rotation)
    covariance = np.zeros((len(planes), 6, 6))
    covariance[:, [[0], [1], [5]], [0, 1, 5]] = table.inplane_covariance[planes.row] + SAME * np.eye(3)
    # (a, b, c) is (z, -yaw, tilt) for small angles.
    order = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    covariance[:, 2:5, 2:5] = order @ planes.covariance @ order.T
    return RelativePoses(planes.first, planes.second, poses, covariance)
