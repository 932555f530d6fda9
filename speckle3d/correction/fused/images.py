"""What the images say: relative poses of frames, and the errors that many of them share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.geometry import adjoint
from speckle3d.core.relative import SCALE_CHANGE_MM, SHARED, TURN_CHANGE_MM, RelativePoses
from speckle3d.correction.fused.problem import Block, Normal
from speckle3d.matching.schedule import TrajectorySettings

TWIST = [3, 4, 5, 0, 1, 2]
"""(x, y, z, tilt, yaw, roll) of covariances to the (rotation, translation) of exponential coordinates, and
back."""
ERRORS = [5, 0, 1]
"""Where errors along a sweep, (z, tilt, yaw), are in a twist."""
HELD_MM, HELD_RAD = 1.0, 0.05
"""How far neighbouring frames may be from where `image` has them if nothing else joins them."""
RETURN_MM = 1.0
"""An edge is between visits of one place if the probe travelled so much farther between its frames than they
are apart."""
LEAST_STEP_MM = 0.005
"""Steps count as at least so long in what errors may change over them: no step is exact."""
HUBER = TrajectorySettings().huber
"""Deviations at which an edge begins to lose weight: as where the trajectory was solved from them."""
COMPARED = 12
"""Frames at which claimed covariances are compared with those of the graph."""


@dataclass(frozen=True)
class ImageEvidence:
    """Edges of a sweep, and how far they may be wrong together.

    Attributes
    ----------
    edges : RelativePoses
        About the image's centre.
    start : RigidTransform, length n
        ``first_from_frame`` about the image's centre, by the images alone.
    covariance : ndarray, shape (n, 6, 6)
        Claimed for the images' poses.
    scale_sigma : float
        Relative standard deviation of the scale of all steps.
    turn_sigma_per_mm : ndarray, shape (2,)
        Of the tilt and the yaw that images lack, rad/mm.
    """

    edges: RelativePoses
    start: RigidTransform
    covariance: FloatArray
    scale_sigma: float
    turn_sigma_per_mm: FloatArray

    def __len__(self) -> int:
        return len(self.start)

    @cached_property
    def z_mm(self) -> FloatArray:
        """Elevational place of every frame by the images, shape (n,)."""
        return np.asarray(self.start.translation[:, 2])

    @cached_property
    def steps_mm(self) -> FloatArray:
        """Signed travel along each frame's own z into the next, shape (n - 1,)."""
        return np.asarray((self.start[:-1].inv() * self.start[1:]).translation[:, 2])

    @cached_property
    def along_mm(self) -> FloatArray:
        """Sum of `steps_mm` up to each frame, shape (n,)."""
        return np.concatenate([[0.0], np.cumsum(self.steps_mm)])

    @cached_property
    def travel_mm(self) -> FloatArray:
        """Distance travelled up to each frame, shape (n,)."""
        return np.concatenate([[0.0], np.cumsum(np.abs(self.steps_mm))])

    @cached_property
    def parts(self) -> tuple[IntArray, FloatArray]:
        """Frames whose places, with these weights, give the travel there and back: sums to `path_mm`."""
        farthest, last = int(np.argmax(np.abs(self.along_mm))), len(self) - 1
        side = 1.0 if self.along_mm[farthest] > 0 else -1.0
        if farthest == last:
            return np.array([last]), np.array([side])
        return np.array([farthest, last]), side * np.array([2.0, -1.0])

    @cached_property
    def path_mm(self) -> float:
        """Travel to the farthest frame, and from there to the last."""
        frames, weight = self.parts
        return float(weight @ self.along_mm[frames])

    @cached_property
    def returns(self) -> BoolArray:
        """Which edges join visits of one place, shape (e,)."""
        travelled = np.abs(self.travel_mm[self.edges.second] - self.travel_mm[self.edges.first])
        return np.asarray(travelled > np.abs(self.edges.poses.translation[:, 2]) + RETURN_MM)

    @cached_property
    def growth(self) -> FloatArray:
        """Deviations of (x, y, z, tilt, yaw, roll) over those of independent edges, shape (6,).

        Those of x, y and roll are read off the claimed covariance, where the structure of the tissue makes
        them larger; the others' are the same for all tissue.
        """
        claimed = self.covariance.copy()
        tilt, yaw = self.turn_sigma_per_mm
        claimed[:, 0, 0] -= (yaw * self.z_mm**2 / 2) ** 2
        claimed[:, 1, 1] -= (tilt * self.z_mm**2 / 2) ** 2
        growth = SHARED.copy()
        some, graph = self._graph
        for axis in (0, 1, 5):
            ratio = claimed[some, axis, axis] / graph[:, axis, axis]
            growth[axis] = max(growth[axis], float(np.sqrt(max(np.median(ratio), 0.0))))
        return growth

    @cached_property
    def change_sigma(self) -> float:
        """Relative standard deviation of the part of the scale that changes along the sweep.

        The images' own claim, without what is added for curves of another probe, which is the same all along.
        """
        some, graph = self._graph
        left = self.covariance[some, 2, 2] - SHARED[2] ** 2 * graph[:, 2, 2]
        unit = self.z_mm[some] ** 2 + SCALE_CHANGE_MM * self.travel_mm[some]
        return min(self.scale_sigma, float(np.sqrt(max(np.median(left / unit), 0.0))))

    @cached_property
    def _graph(self) -> tuple[IntArray, FloatArray]:
        """Some frames, and their covariance were edges independent and without common errors."""
        n = len(self)
        some = np.unique(np.linspace(1, n - 1, min(n - 1, COMPARED)).round().astype(int))
        normal = Normal.of([self._alone(), self._held(self.start)], 6 * (n - 1))
        rows = pose_columns(some)
        unit = np.zeros((6 * (n - 1), rows.size))
        unit[rows.ravel(), np.arange(rows.size)] = 1.0
        solved = normal.factor().solve(unit).reshape(-1, some.size, 6)
        blocks = np.stack([solved[rows[k], k] for k in range(some.size)])
        return some, blocks[:, TWIST][:, :, TWIST]

    def _alone(self) -> Block:
        first, second = self.edges.first, self.edges.second
        relative = self.start[first].inv() * self.start[second]
        w = self._independent
        error = np.einsum("eij,ej->ei", w, (self.edges.poses.inv() * relative).as_exp_coords())
        weight = np.minimum(1.0, HUBER / np.maximum(np.linalg.norm(error, axis=1) / np.sqrt(6), 1e-9))
        parts = ((pose_columns(first), -w @ adjoint(relative.inv())), (pose_columns(second), w))
        return Block(error, parts).weighted(weight)

    def _whitening(self, growth: FloatArray) -> FloatArray:
        """Whitening of edges' twists, shape (e, 6, 6)."""
        covariance = self.edges.covariance * np.outer(growth, growth)
        return np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)[:, :, TWIST]

    @cached_property
    def _independent(self) -> FloatArray:
        return self._whitening(np.ones(6))

    @cached_property
    def _grown(self) -> FloatArray:
        return self._whitening(self.growth)

    def blocks(self, poses: RigidTransform, distortion: FloatArray, common: FloatArray) -> list[Block]:
        """Equations of the images, and of the errors that their edges share.

        Parameters
        ----------
        poses : RigidTransform, length n
            ``first_from_frame`` about the image's centre.
        distortion : ndarray, shape (n, 3)
            True motion up to each frame less that of the images: along z, mm; tilt and yaw, rad.
        common : ndarray, shape (3,)
            Logarithm of the scale; tilt and yaw per mm that the images lack.
        """
        edges = self._with_errors(poses, distortion, common)
        sigma = np.array([self.scale_sigma, *self.turn_sigma_per_mm])
        prior = Block((common / sigma)[None], ((self.common_columns[None], np.diag(1.0 / sigma)[None]),))
        held = self._held(poses)
        return [edges, held, self._changes(distortion, common), prior]

    @property
    def size(self) -> int:
        """Number of variables: six a frame and three errors a frame after the first, and three in common."""
        return 9 * (len(self) - 1) + 3

    @property
    def common_columns(self) -> IntArray:
        """Columns of the common errors."""
        return 9 * (len(self) - 1) + np.arange(3)

    def error_columns(self, frames: IntArray) -> IntArray:
        """Columns of the shared errors up to some frames, shape (m, 3); below zero for the first."""
        columns = 6 * (len(self) - 1) + 3 * (frames[:, None] - 1) + np.arange(3)
        return np.where(frames[:, None] > 0, columns, -1)

    def drifts(self, common: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors that a mm travelled adds on the whole, (3,), and their derivatives by the common ones."""
        scale = float(np.exp(common[0]))
        return np.array([scale - 1.0, *common[1:]]), np.diag([scale, 1.0, 1.0])

    def _with_errors(self, poses: RigidTransform, distortion: FloatArray, common: FloatArray) -> Block:
        first, second = self.edges.first, self.edges.second
        relative = poses[first].inv() * poses[second]
        error = (self.edges.poses.inv() * relative).as_exp_coords()
        per_mm, slope = self.drifts(common)
        apart = self.edges.poses.translation[:, 2]
        shared = np.where(
            self.returns[:, None], per_mm * apart[:, None], distortion[second] - distortion[first]
        )
        error[:, ERRORS] -= shared
        alone = np.einsum("eij,ej->ei", self._independent, error)
        weight = np.minimum(1.0, HUBER / np.maximum(np.linalg.norm(alone, axis=1) / np.sqrt(6), 1e-9))
        w = self._grown
        of_errors = -w[:, :, ERRORS]
        on_path = np.where(self.returns, 0.0, 1.0)[:, None, None]
        own = of_errors @ slope * (apart * self.returns)[:, None, None]
        common_columns = np.broadcast_to(self.common_columns, (len(self.edges), 3))
        block = Block(
            np.einsum("eij,ej->ei", w, error),
            (
                (pose_columns(first), -w @ adjoint(relative.inv())),
                (pose_columns(second), w),
                (self.error_columns(second), of_errors * on_path),
                (self.error_columns(first), -of_errors * on_path),
                (common_columns, own),
            ),
        )
        return block.weighted(weight)

    def _held(self, poses: RigidTransform) -> Block:
        """Neighbouring frames, which no edge may join, near to where the images have them."""
        after = np.arange(1, len(self))
        relative = poses[:-1].inv() * poses[1:]
        seen = self.start[:-1].inv() * self.start[1:]
        w = np.diag([1.0 / HELD_RAD] * 3 + [1.0 / HELD_MM] * 3)
        return Block(
            (seen.inv() * relative).as_exp_coords() @ w,
            (
                (pose_columns(after - 1), -w @ adjoint(relative.inv())),
                (pose_columns(after), np.broadcast_to(w, (after.size, 6, 6))),
            ),
        )

    def _changes(self, distortion: FloatArray, common: FloatArray) -> Block:
        """Errors grow with the signed distance by what is common, and wander with the travel."""
        step = self.steps_mm[:, None]
        travel = np.maximum(np.abs(step), LEAST_STEP_MM)
        sigma = np.sqrt(
            travel
            * [
                self.change_sigma**2 * SCALE_CHANGE_MM,
                *(self.turn_sigma_per_mm**2 * TURN_CHANGE_MM),
            ]
        )
        per_mm, slope = self.drifts(common)
        after = np.arange(1, len(self))
        each = np.apply_along_axis(np.diag, 1, 1.0 / sigma)
        return Block(
            (np.diff(distortion, axis=0) - per_mm * step) / sigma,
            (
                (self.error_columns(after), each),
                (self.error_columns(after - 1), -each),
                (
                    np.broadcast_to(self.common_columns, (after.size, 3)),
                    -each @ slope * step[:, :, None],
                ),
            ),
        )


def pose_columns(frames: IntArray) -> IntArray:
    """Columns of the poses of some frames, shape (m, 6); below zero for the first, which is fixed."""
    columns = 6 * (frames[:, None] - 1) + np.arange(6)
    return np.where(frames[:, None] > 0, columns, -1)
