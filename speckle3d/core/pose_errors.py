"""Errors that all frames' poses have together, and what they do to points and to integrals over surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.shown import shown

COMPONENTS = 6


@dataclass(frozen=True)
class PoseErrors:
    """Joint errors of all frames' poses: `factors`, contracted with independent standard normal variables.

    Parameters
    ----------
    factors : ndarray, shape (m, n, 6)
        Of m variables and n frames: (x, y, z, tilt, yaw, roll) about the image's centre, along the first
        frame's axes, mm and rad.

    Examples
    --------
    One variable, an error of the scale of 2 %, in three frames 1 mm apart:

    >>> factors = np.zeros((1, 3, 6))
    >>> factors[0, :, 2] = 0.02 * np.arange(3)
    >>> np.sqrt(PoseErrors(factors).covariance()[:, 2, 2]).round(3).tolist()
    [0.0, 0.02, 0.04]
    """

    factors: FloatArray

    def __post_init__(self) -> None:
        shape = self.factors.shape
        if len(shape) != 3 or shape[2] != COMPONENTS or not np.isfinite(self.factors).all():
            raise InvalidInputError(f"factors: expected finite values of shape (m, n, 6), got shape {shape}")

    def __len__(self) -> int:
        """Number of frames."""
        return int(self.factors.shape[1])

    def covariance(self) -> FloatArray:
        """Covariance of each frame's pose, shape (n, 6, 6)."""
        return np.asarray(np.einsum("mia,mib->iab", self.factors, self.factors))

    def between(self, first: int, second: int) -> FloatArray:
        """Covariance of two frames' errors with each other, shape (6, 6)."""
        return np.asarray(self.factors[:, first].T @ self.factors[:, second])

    def require_of(self, world_from_image: RigidTransform) -> None:
        """Raise `MismatchError` unless there are as many poses as frames here."""
        if len(world_from_image) != len(self):
            raise MismatchError(f"expected {len(self)} poses, as their errors, got {len(world_from_image)}")


@dataclass(frozen=True)
class Belonging:
    """Which frames points belong to: two each, with weights that add up to one.

    Attributes
    ----------
    frames : ndarray of int, shape (k, 2)
    weights : ndarray, shape (k, 2)
    gap_mm : ndarray, shape (k,)
        Distance to the nearer frame's image; of points between two frames, within its plane.
    """

    frames: IntArray
    weights: FloatArray
    gap_mm: FloatArray

    def __getitem__(self, rows: slice | IntArray) -> Belonging:
        return Belonging(self.frames[rows], self.weights[rows], self.gap_mm[rows])


@shown
@dataclass(frozen=True)
class PosedErrors:
    """Errors of poses together with the poses: what points of the world move by.

    A point moves with the frames it belongs to, as with rigid bodies.

    Parameters
    ----------
    errors : PoseErrors, of n frames
    world_from_image : RigidTransform, length n
    centre_mm : ndarray, shape (3,)
        The image's centre, in the image.
    """

    errors: PoseErrors
    world_from_image: RigidTransform
    centre_mm: FloatArray

    def __post_init__(self) -> None:
        self.errors.require_of(self.world_from_image)

    @property
    def variables(self) -> int:
        """How many independent variables the errors are made of."""
        return int(self.errors.factors.shape[0])

    def displacements(self, points_mm: FloatArray, belonging: Belonging) -> FloatArray:
        """Displacements of points for one deviation of each variable, in the world, shape (m, k, 3), mm."""
        along = self._axes().inv()
        centres = along.apply(self.world_from_image.apply(self.centre_mm))
        points = along.apply(points_mm)
        moved = np.zeros((self.variables, *points.shape))
        for side in range(belonging.frames.shape[1]):
            frames, weight = belonging.frames[:, side], belonging.weights[:, side, None]
            error = self.errors.factors[:, frames]
            moved += weight * (error[:, :, :3] + np.cross(error[:, :, 3:], points - centres[frames]))
        return np.asarray(moved @ self._axes().as_matrix().T)

    def variance(self, points_mm: FloatArray, directions: FloatArray, belonging: Belonging) -> FloatArray:
        """Variance of points' places along directions, shape (k,), mm2; frames of a pair must be neighbours.

        The same as by `displacements`, from covariances of frames and of neighbours: for many points.

        Parameters
        ----------
        points_mm, directions : ndarray, shape (k, 3)
            In the world; directions of length one.
        """
        factors = self.errors.factors
        along = self._axes().inv()
        centres = along.apply(self.world_from_image.apply(self.centre_mm))
        points, towards = along.apply(points_mm), along.apply(directions)
        arms = [
            weight[:, None] * np.concatenate([towards, np.cross(points - centres[frame], towards)], axis=1)
            for frame, weight in zip(belonging.frames.T, belonging.weights.T, strict=True)
        ]
        own, next_ = self.errors.covariance(), np.einsum("mia,mib->iab", factors[:, :-1], factors[:, 1:])
        total = sum(
            np.einsum("ka,kab,kb->k", arm, own[frame], arm, optimize=True)
            for arm, frame in zip(arms, belonging.frames.T, strict=True)
        )
        first, second = belonging.frames.T
        forward = second > first
        pair = (
            next_[np.clip(np.minimum(first, second), 0, max(len(next_) - 1, 0))] if len(next_) else own[first]
        )
        pair = np.where(forward[:, None, None], pair, pair.transpose(0, 2, 1))
        return np.asarray(total + 2.0 * np.einsum("ka,kab,kb->k", arms[0], pair, arms[1], optimize=True))

    def of_gradient(self, points_mm: FloatArray, gradient: FloatArray, belonging: Belonging) -> FloatArray:
        """What a quantity changes by for one deviation of each variable, shape (m,).

        Forces on a rigid body add up to one force and one torque: of a million points, n frames are left.

        Parameters
        ----------
        points_mm, gradient : ndarray, shape (k, 3)
            Points in the world, and the quantity's derivative with respect to each.
        """
        along = self._axes().inv()
        centres = along.apply(self.world_from_image.apply(self.centre_mm))
        points, pull = along.apply(points_mm), along.apply(gradient)
        total = np.zeros((len(self.errors), COMPONENTS))
        for side in range(belonging.frames.shape[1]):
            frames, force = belonging.frames[:, side], belonging.weights[:, side, None] * pull
            both = np.concatenate([force, np.cross(points - centres[frames], force)], axis=1)
            for component in range(COMPONENTS):
                total[:, component] += np.bincount(frames, both[:, component], len(total))
        return np.asarray(np.einsum("mia,ia->m", self.errors.factors, total))

    def _axes(self) -> Rotation:
        """The first frame's axes in the world."""
        return self.world_from_image[0].rotation
