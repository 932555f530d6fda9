"""What the images say: relative poses of frames, and the errors that many of them share."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
RETURN_RAD = 0.03
"""How far a probe may be turned that comes back to a place: two degrees."""
SLOW, SLOW_RAD = 4, 0.01
"""Number of slow curves by which tilt and yaw are off, and the deviation of the slowest: 0.6 degrees. A hand
turns by as much in a sweep, which images hardly see."""
LEAST_STEP_MM = 0.005
"""Steps count as at least so long in what errors may change over them: no step is exact."""
HUBER = TrajectorySettings().huber
"""Deviations at which an edge begins to lose weight: as where the trajectory was solved from them."""
FRAMES_A_KNOT, MOST_KNOTS = 4, 40
"""Changing errors are straight lines over so many frames, or more in a sweep of very many."""
TAIL = 4.0
"""Degrees of freedom of the common errors' distribution, Student's."""
LEAST_CHANGE = 0.1
"""The scale changes along a sweep by at least so much of what it may be wrong by."""
COMPARED = 12
"""Frames at which claimed covariances are compared with those of the graph."""


@dataclass(frozen=True)
class ErrorSize:
    """Factors of the deviations of shared errors, (z, tilt, yaw) each: common ones, and changing ones."""

    common: FloatArray
    changing: FloatArray


@dataclass(frozen=True)
class ImageErrors:
    """What the images' steps have wrong together.

    Attributes
    ----------
    common : ndarray, shape (3,)
        Logarithm of the scale; tilt and yaw per mm that the images lack.
    slow : ndarray, shape (4, 2)
        Weights of slow curves in tilt and yaw, rad.
    changing : ndarray, shape (k + 1, 3)
        What is wrong beyond that at the knots: z, mm; tilt and yaw, rad. Zero at the first.
    """

    common: FloatArray
    slow: FloatArray
    changing: FloatArray

    @property
    def per_mm(self) -> FloatArray:
        """Common errors that a mm travelled by the images adds."""
        return np.array([np.exp(self.common[0]) - 1.0, *self.common[1:]])

    @property
    def per_mm_slope(self) -> FloatArray:
        """Derivatives of `per_mm`."""
        return np.diag([np.exp(self.common[0]), 1.0, 1.0])


@dataclass(frozen=True)
class ImageEvidence:
    """Edges of a sweep, and how far they may be wrong together.

    Attributes
    ----------
    edges : RelativePoses
        About the image's centre.
    start : RigidTransform, length n
        ``first_from_frame`` about the image's centre, by the images alone.
    scale_sigma : float
        Relative standard deviation of the scale of all steps.
    turn_sigma_per_mm : ndarray, shape (2,)
        Of the tilt and the yaw that images lack, rad/mm.
    growth : ndarray, shape (6,)
        Deviations of (x, y, z, tilt, yaw, roll) over those of independent edges.
    change_sigma : float
        Relative standard deviation of the part of the scale that changes along the sweep.
    """

    edges: RelativePoses
    start: RigidTransform
    scale_sigma: float
    turn_sigma_per_mm: FloatArray
    growth: FloatArray
    change_sigma: float

    def __len__(self) -> int:
        return len(self.start)

    @classmethod
    def of(
        cls,
        edges: RelativePoses,
        start: RigidTransform,
        covariance: FloatArray,
        scale_sigma: float,
        turn_sigma_per_mm: FloatArray,
    ) -> ImageEvidence:
        """Evidence with the errors that many edges share, as far as a claimed covariance tells them.

        Deviations of x, y and roll over those of independent edges are read off the claim, where the
        structure of the tissue makes them larger; the others' are the same for all tissue. So is the scale
        that changes along the sweep: without what is added for curves of another probe.

        Parameters
        ----------
        covariance : ndarray, shape (n, 6, 6)
            Claimed for `start`.
        """
        alone = cls(edges, start, scale_sigma, turn_sigma_per_mm, np.ones(6), scale_sigma)
        some, graph = alone.independent()
        z_mm, claimed = alone.z_mm[some], np.diagonal(covariance[some], axis1=1, axis2=2).copy()
        tilt, yaw = turn_sigma_per_mm
        claimed[:, 0] -= (yaw * z_mm**2 / 2) ** 2
        claimed[:, 1] -= (tilt * z_mm**2 / 2) ** 2
        grown = np.sqrt(np.maximum(np.median(claimed / graph, axis=0), 0.0))
        growth = np.where([True, True, False, False, False, True], np.maximum(SHARED, grown), SHARED)
        unit = z_mm**2 + SCALE_CHANGE_MM * alone.travel_mm[some]
        change = np.median((claimed[:, 2] - SHARED[2] ** 2 * graph[:, 2]) / np.maximum(unit, 1e-9))
        own = min(scale_sigma, max(float(np.sqrt(max(change, 0.0))), LEAST_CHANGE * scale_sigma))
        return replace(alone, growth=growth, change_sigma=own)

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

    def independent(self) -> tuple[IntArray, FloatArray]:
        """Some frames, and the variances of their poses had edges no errors in common, shape (k, 6)."""
        n = len(self)
        some = np.unique(np.linspace(1, n - 1, min(n - 1, COMPARED)).round().astype(int))
        normal = Normal.of(self.alone(), 6 * (n - 1))
        columns = pose_columns(some)
        unit = np.zeros((6 * (n - 1), columns.size))
        unit[columns.ravel(), np.arange(columns.size)] = 1.0
        variance = normal.factor().solve(unit)[columns.ravel(), np.arange(columns.size)]
        return some, variance.reshape(-1, 6)[:, TWIST]

    def alone(self) -> list[Block]:
        """Equations of the edges at `start`, as if they had no errors in common."""
        first, second = self.edges.first, self.edges.second
        relative = self.start[first].inv() * self.start[second]
        error = (self.edges.poses.inv() * relative).as_exp_coords()
        w = self._independent
        parts = ((pose_columns(first), -w @ adjoint(relative.inv())), (pose_columns(second), w))
        edges = Block(np.einsum("eij,ej->ei", w, error), parts).weighted(self._doubtful(error))
        return [edges, self._held(self.start)]

    def _whitening(self, growth: FloatArray) -> FloatArray:
        """Whitening of edges' twists, shape (e, 6, 6)."""
        covariance = self.edges.covariance * np.outer(growth, growth)
        # Images see a turn only through the distance it comes with, and there is none between two visits.
        covariance[:, [3, 4], [3, 4]] += np.where(self.returns, RETURN_RAD**2, 0.0)[:, None]
        return np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)[:, :, TWIST]

    @cached_property
    def _independent(self) -> FloatArray:
        return self._whitening(np.ones(6))

    @cached_property
    def _grown(self) -> FloatArray:
        return self._whitening(self.growth)

    def blocks(self, poses: RigidTransform, errors: ImageErrors) -> list[Block]:
        """Equations of the edges, given the errors that they share.

        Parameters
        ----------
        poses : RigidTransform, length n
            ``first_from_frame`` about the image's centre.
        """
        return [self._with_errors(poses, errors), self._held(poses)]

    def prior_blocks(self, errors: ImageErrors, size: ErrorSize) -> list[Block]:
        """Equations of what is known of the shared errors beforehand."""
        sigma = size.common * np.array([self.scale_sigma, *self.turn_sigma_per_mm])
        # A heavy tail: curves of another probe, or a probe that is turned on purpose, are rare but no wonder.
        weight = (TAIL + 1.0) / (TAIL + (errors.common / sigma) ** 2)
        each = np.diag(np.sqrt(weight) / sigma)
        common = Block((each @ errors.common)[None], ((self.common_columns[None], each[None]),))
        known = 1.0 / (SLOW_RAD * np.outer(1.0 / np.arange(1, SLOW + 1), size.common[1:]).ravel())
        slow = Block((errors.slow.ravel() * known)[None], ((self.slow_columns[None], np.diag(known)[None]),))
        return [common, slow, self._changes(errors, size)]

    @cached_property
    def knots(self) -> IntArray:
        """Frames between which changing errors are straight lines, shape (k + 1,)."""
        n = len(self)
        count = int(np.clip((n - 1) // FRAMES_A_KNOT, 1, MOST_KNOTS))
        return np.unique(np.linspace(0, n - 1, count + 1).round().astype(int))

    @property
    def size(self) -> int:
        """Number of variables: six a frame after the first, three errors a knot, and three in common."""
        return 6 * (len(self) - 1) + self.error_size

    @property
    def error_size(self) -> int:
        """Number of the last of these, which are not poses."""
        return 3 + 2 * SLOW + 3 * (self.knots.size - 1)

    @property
    def common_columns(self) -> IntArray:
        """Columns of the common errors."""
        return 6 * (len(self) - 1) + np.arange(3)

    @property
    def slow_columns(self) -> IntArray:
        """Columns of the slow curves' weights."""
        return 6 * (len(self) - 1) + 3 + np.arange(2 * SLOW)

    def knot_columns(self, knots: IntArray) -> IntArray:
        """Columns of the changing errors at some knots, shape (m, 3); below zero for the first."""
        columns = 6 * (len(self) - 1) + 2 * SLOW + 3 * knots[:, None] + np.arange(3)
        return np.where(knots[:, None] > 0, columns, -1)

    @cached_property
    def _knot(self) -> tuple[IntArray, FloatArray]:
        """Knot before each frame, and the share of the way to the next."""
        frame = np.arange(len(self))
        before = np.clip(np.searchsorted(self.knots, frame, "right") - 1, 0, self.knots.size - 2)
        return before, (frame - self.knots[before]) / np.diff(self.knots)[before]

    def distortion(self, errors: ImageErrors) -> FloatArray:
        """True motion up to each frame less that of the images: z, mm; tilt and yaw, rad; shape (n, 3)."""
        before, share = self._knot
        changed = (
            errors.changing[before] * (1 - share)[:, None] + errors.changing[before + 1] * share[:, None]
        )
        changed[:, 1:] += self.curves @ errors.slow
        return np.asarray(errors.per_mm * self.along_mm[:, None] + changed)

    @cached_property
    def curves(self) -> FloatArray:
        """Slow curves, zero at the first frame, shape (n, 4)."""
        part = np.linspace(0.0, np.pi, len(self))
        return np.asarray(1.0 - np.cos(np.outer(part, np.arange(1, SLOW + 1))))

    def distortion_parts(
        self, frames: IntArray, weights: FloatArray, errors: ImageErrors, slope: FloatArray
    ) -> tuple[tuple[IntArray, FloatArray], ...]:
        """Parts of equations about weighted sums of some frames' distortion.

        Parameters
        ----------
        frames : ndarray of int, shape (m, f)
        weights : ndarray, shape (m, f)
        slope : ndarray, shape (m, k, 3)
            Derivatives of the equations by the sums.
        """
        parts = []
        for frame, weight in zip(frames.T, weights.T, strict=True):
            before, share = self._knot[0][frame], self._knot[1][frame]
            parts.append((self.knot_columns(before), slope * (weight * (1 - share))[:, None, None]))
            parts.append((self.knot_columns(before + 1), slope * (weight * share)[:, None, None]))
        along = (weights * self.along_mm[frames]).sum(axis=1)
        curves = np.einsum("mf,mfs->ms", weights, self.curves[frames])
        turned = np.einsum("ms,mkt->mkst", curves, slope[:, :, 1:]).reshape(*slope.shape[:2], -1)
        shared = np.concatenate([self.common_columns, self.slow_columns])
        both = np.concatenate([slope @ errors.per_mm_slope * along[:, None, None], turned], axis=2)
        return (*parts, (np.broadcast_to(shared, (len(frames), shared.size)), both))

    def _with_errors(self, poses: RigidTransform, errors: ImageErrors) -> Block:
        first, second = self.edges.first, self.edges.second
        relative = poses[first].inv() * poses[second]
        error = (self.edges.poses.inv() * relative).as_exp_coords()
        apart, distortion = self.edges.poses.translation[:, 2], self.distortion(errors)
        error[:, ERRORS] -= np.where(
            self.returns[:, None], errors.per_mm * apart[:, None], distortion[second] - distortion[first]
        )
        w = self._grown
        slope = -w[:, :, ERRORS]
        on_path = slope * np.where(self.returns, 0.0, 1.0)[:, None, None]
        of_return = slope @ errors.per_mm_slope * (apart * self.returns)[:, None, None]
        common = np.broadcast_to(self.common_columns, (len(self.edges), 3))
        ends = np.column_stack([first, second])
        return Block(
            np.einsum("eij,ej->ei", w, error),
            (
                (pose_columns(first), -w @ adjoint(relative.inv())),
                (pose_columns(second), w),
                *self.distortion_parts(ends, np.tile([-1.0, 1.0], (len(ends), 1)), errors, on_path),
                (common, of_return),
            ),
        ).weighted(self._doubtful(error))

    def _doubtful(self, error: FloatArray) -> FloatArray:
        """Weights of edges by their twists' errors, as where the trajectory was solved from them."""
        size = np.linalg.norm(np.einsum("eij,ej->ei", self._independent, error), axis=1) / np.sqrt(6)
        return np.asarray(np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))

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

    def _changes(self, errors: ImageErrors, size: ErrorSize) -> Block:
        """Errors change with the travel from knot to knot."""
        travel = np.maximum(np.diff(self.travel_mm[self.knots]), LEAST_STEP_MM * np.diff(self.knots))
        density = [self.change_sigma**2 * SCALE_CHANGE_MM, *(self.turn_sigma_per_mm**2 * TURN_CHANGE_MM)]
        sigma = np.sqrt(travel[:, None] * density) * size.changing
        each = np.apply_along_axis(np.diag, 1, 1.0 / sigma)
        after = np.arange(1, self.knots.size)
        return Block(
            np.diff(errors.changing, axis=0) / sigma,
            ((self.knot_columns(after), each), (self.knot_columns(after - 1), -each)),
        )


def pose_columns(frames: IntArray) -> IntArray:
    """Columns of the poses of some frames, shape (m, 6); below zero for the first, which is fixed."""
    columns = 6 * (frames[:, None] - 1) + np.arange(6)
    return np.where(frames[:, None] > 0, columns, -1)
