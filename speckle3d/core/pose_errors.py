"""Errors that all frames' poses have together, and what they do to points and to integrals over surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError, MismatchError
from speckle3d.core.shown import shown


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
        if len(shape) != 3 or shape[2] != 6 or not np.isfinite(self.factors).all():
            raise InvalidInputError(f"factors: expected finite values of shape (m, n, 6), got shape {shape}")

    def __len__(self) -> int:
        """Number of frames."""
        return int(self.factors.shape[1])

    def covariance(self) -> FloatArray:
        """Covariance of each frame's pose, shape (n, 6, 6)."""
        return np.asarray(np.einsum("mia,mib->iab", self.factors, self.factors))


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
        if len(self.world_from_image) != len(self.errors):
            raise MismatchError(
                f"expected {len(self.errors)} poses, as their errors, got {len(self.world_from_image)}"
            )

    def variance(self, points_mm: FloatArray, directions: FloatArray, belonging: Belonging) -> FloatArray:
        """Variance of points' places along directions, shape (k,), mm2.

        Parameters
        ----------
        points_mm, directions : ndarray, shape (k, 3)
            In the world; directions of length one.
        """
        moved = self._shares(belonging) @ self._screws.reshape(len(self.errors), -1)
        moments = np.hstack([directions, np.cross(points_mm, directions)])
        along = np.einsum("ka,kam->km", moments, moved.reshape(*moments.shape, -1))
        return np.asarray((along**2).sum(axis=1))

    def of_gradient(self, points_mm: FloatArray, gradient: FloatArray, belonging: Belonging) -> FloatArray:
        """What a quantity changes by for one deviation of each variable, shape (m,).

        Parameters
        ----------
        points_mm, gradient : ndarray, shape (k, 3)
            Points in the world, and the quantity's derivative with respect to each.
        """
        moments = np.hstack([gradient, np.cross(points_mm, gradient)])
        return np.asarray(np.einsum("na,nam->m", self._shares(belonging).T @ moments, self._screws))

    @property
    def _screws(self) -> FloatArray:
        """What each variable moves and turns each frame by, about the world's origin, shape (n, 6, m).

        What it displaces a point by along a force is the product with the force and its moment.
        """
        along = self.world_from_image[0].rotation.as_matrix().T
        shift, turn = self.errors.factors[..., :3] @ along, self.errors.factors[..., 3:] @ along
        centres = self.world_from_image.apply(self.centre_mm)
        return np.concatenate([shift - np.cross(turn, centres), turn], axis=-1).transpose(1, 2, 0)

    def _shares(self, belonging: Belonging) -> csr_array:
        """Weight of each frame at each point, shape (k, n)."""
        k = len(belonging.weights)
        rows = 2 * np.arange(k + 1)
        return csr_array((belonging.weights.ravel(), belonging.frames.ravel(), rows), (k, len(self.errors)))
