"""Joint errors of all frames' poses, propagated to points and to integrals over surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.shown import shown


class Belonging(NamedTuple):
    """Two frames for each point, with interpolation weights that sum to one.

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

    def of_points(self, rows: IntArray) -> Belonging:
        """Frames and weights of a subset of the points."""
        return Belonging(self.frames[rows], self.weights[rows], self.gap_mm[rows])


@shown
@dataclass(frozen=True)
class PoseErrors:
    """Joint errors of all frames' poses: `factors`, contracted with independent standard normal variables.

    A point moves with the frames it belongs to, as with rigid bodies.

    Parameters
    ----------
    factors : ndarray, shape (m, n, 6)
        Of m variables and n frames: (x, y, z, tilt, yaw, roll) about the image's centre, along the first
        frame's axes, mm and rad.
    world_from_image : RigidTransform, length n
    centre_mm : ndarray, shape (3,)
        The image's centre, in the image.

    Examples
    --------
    One variable, an error of the scale of 2 %, in three frames 1 mm apart:

    >>> factors = np.zeros((1, 3, 6))
    >>> factors[0, :, 2] = 0.02 * np.arange(3)
    >>> errors = PoseErrors(factors, RigidTransform.identity(3), np.zeros(3))
    >>> np.sqrt(errors.covariance()[:, 2, 2]).round(3).tolist()
    [0.0, 0.02, 0.04]
    """

    factors: FloatArray
    world_from_image: RigidTransform
    centre_mm: FloatArray

    def covariance(self) -> FloatArray:
        """Covariance of each frame's pose, shape (n, 6, 6)."""
        return np.asarray(np.einsum("mia,mib->iab", self.factors, self.factors))

    def variance(self, points_mm: FloatArray, directions: FloatArray, belonging: Belonging) -> FloatArray:
        """Variance of points' places along directions, shape (k,), mm2.

        Parameters
        ----------
        points_mm, directions : ndarray, shape (k, 3)
            In the world; directions of length one.
        """
        forces, screws = _forces(points_mm, directions, belonging), self._screws
        along = np.sum([forces[:, j, None] @ screws[belonging.frames[:, j]] for j in (0, 1)], axis=0)
        return np.asarray((along**2).sum(axis=(1, 2)))

    def of_gradient(self, points_mm: FloatArray, gradient: FloatArray, belonging: Belonging) -> FloatArray:
        """Change of a quantity for one standard deviation of each variable, shape (m,).

        Parameters
        ----------
        points_mm, gradient : ndarray, shape (k, 3)
            Points in the world, and the quantity's derivative with respect to each.
        """
        frames, n = belonging.frames.T.ravel(), len(self.world_from_image)
        forces = [np.bincount(frames, f.ravel(), n) for f in _forces(points_mm, gradient, belonging).T]
        return np.asarray(np.einsum("an,nam->m", forces, self._screws))

    @property
    def _screws(self) -> FloatArray:
        """Displacement and rotation of each frame by each variable, about the origin, shape (n, 6, m).

        What it displaces a point by along a force is the product with the force and its moment.
        """
        along = self.world_from_image[0].rotation.as_matrix().T
        shift, turn = self.factors[..., :3] @ along, self.factors[..., 3:] @ along
        centres = self.world_from_image.apply(self.centre_mm)
        return np.concatenate([shift - np.cross(turn, centres), turn], axis=-1).transpose(1, 2, 0)


def _forces(points_mm: FloatArray, along: FloatArray, belonging: Belonging) -> FloatArray:
    """Gradients at points and their moments, distributed to the points' frames, shape (k, 2, 6)."""
    moments = np.hstack([along, np.cross(points_mm, along)])
    return np.asarray(belonging.weights[..., None] * moments[:, None])
