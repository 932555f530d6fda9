"""A chain of poses bent by smooth per-frame corrections, and its derivatives.

Housden et al. correct every step of a sensorless reconstruction by a small transform C_f whose six
parameters are cubic curves, with a free offset at the first frame. In pose form

    M_0 = S_0 C_0,    M_f = M_{f-1} (S_{f-1}^-1 S_f) C_f

so a change of C_g moves every later frame rigidly. Each column of the Jacobian is therefore a running sum
of twists along the chain, and all of them cost one pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import relative_poses, rotation_from_fixed_angles, skew

Curves = Literal["time", "distance"]

AXES = ("x", "y", "z", "tilt", "yaw", "roll")
"""Order of the six parameters of a correction."""

ELEVATIONAL = ("z", "tilt", "yaw")
"""Parameters that speckle decorrelation biases, in proportion to the distance travelled."""

CUBIC = 3
"""Degree of the curves; with the first frame's offset each has two coefficients more."""


def cumulative_product(matrices: FloatArray) -> FloatArray:
    """Products ``matrices[0] @ ... @ matrices[f]`` for every f, shape (n, 4, 4)."""
    # Doubling takes log2(n) array operations; a loop over the frames is ten times slower.
    product, step = matrices.copy(), 1
    while step < len(product):
        product[step:] = product[:-step] @ product[step:]
        step *= 2
    return product


def curve_basis(axes: tuple[str, ...], steps_mm: FloatArray, curves: Curves) -> FloatArray:
    """Weight of every coefficient in every frame's correction, shape (n, len(axes), 5).

    The first coefficient acts on frame 0 alone, the other four on the frames after it. The cubics are
    written in Legendre polynomials of t = f / F, the same curves as the published powers of t but far
    better conditioned, and divided so that coefficients are of the size of the drift over the whole sweep.

    Parameters
    ----------
    steps_mm : ndarray, shape (n - 1,)
        Estimated signed elevational step into each frame after the first.
    curves : {"time", "distance"}
        With "distance" the curves of z, tilt and yaw multiply the step (as a share of the distance
        travelled), because those drifts accumulate with distance and change sign when the probe turns back.
    """
    n = steps_mm.size + 1
    cubic = legendre.legvander(2.0 * np.arange(1, n) / (n - 1) - 1.0, CUBIC)
    basis = np.zeros((n, len(axes), CUBIC + 2))
    basis[0, :, 0] = 1.0
    for a, axis in enumerate(axes):
        if curves == "distance" and axis in ELEVATIONAL:
            share = steps_mm / np.abs(steps_mm).sum()
        else:
            share = np.full(n - 1, 1.0 / (n - 1))
        basis[1:, a, 1:] = cubic * share[:, None]
    return basis


@dataclass(frozen=True)
class CorrectedChain:
    """Poses as a function of the coefficients of their corrections.

    Parameters
    ----------
    steps : ndarray, shape (n, 4, 4)
        The first pose, then every frame's pose in the frame before it.
    axes : tuple of str
        Which of `AXES` are corrected.
    basis : ndarray, shape (n, len(axes), k)
        Weights of k coefficients for each axis: of cubics from `curve_basis`.

    References
    ----------
    .. [1] R. J. Housden et al., "Calibration of an orientation sensor for freehand 3D ultrasound and its
       use in a hybrid acquisition system", BioMedical Engineering OnLine 7:5, 2008, equations 1 to 3.
    """

    steps: FloatArray
    axes: tuple[str, ...]
    basis: FloatArray

    @classmethod
    def of(cls, poses: RigidTransform, axes: tuple[str, ...], basis: FloatArray) -> CorrectedChain:
        """Build the chain of the given uncorrected poses."""
        matrices = poses.as_matrix()
        steps = np.concatenate([matrices[:1], relative_poses(poses).as_matrix()])
        return cls(steps, axes, basis)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of every coefficient, in order."""
        parts = ("offset", *(f"legendre{k}" for k in range(CUBIC + 1)))
        return tuple(f"{axis}_{part}" for axis in self.axes for part in parts)

    @property
    def _columns(self) -> list[int]:
        """Which of `AXES` are corrected, by number."""
        return [AXES.index(axis) for axis in self.axes]

    def values(self, coefficients: FloatArray) -> FloatArray:
        """Every frame's correction in the order of `AXES`, shape (n, 6), mm and rad."""
        values = np.zeros((len(self.steps), len(AXES)))
        per_axis = coefficients.reshape(len(self.axes), -1)
        values[:, self._columns] = np.einsum("faj,aj->fa", self.basis, per_axis)
        return values

    def poses(self, coefficients: FloatArray) -> FloatArray:
        """Corrected poses, shape (n, 4, 4)."""
        return cumulative_product(self.steps @ correction_matrices(self.values(coefficients)))

    def twists(self, coefficients: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Twist of every frame by every coefficient.

        Parameters
        ----------
        poses : ndarray, shape (n, 4, 4)
            As returned by `poses` for the same coefficients.

        Returns
        -------
        turn, shift : ndarray, shape (n, 3, n_coefficients)
            A point at world position X of frame f moves by ``turn x X + shift`` per unit coefficient.
        """
        turn, shift = _world_axes(poses, self.values(coefficients))
        return self._accumulate(turn), self._accumulate(shift)

    def frame_errors(self, coefficients: FloatArray, poses: FloatArray) -> FloatArray:
        """Motion of every frame's origin against the first by every coefficient.

        Returns
        -------
        ndarray, shape (n, 6, n_coefficients)
            (x, y, z, tilt, yaw, roll), mm and rad per unit coefficient.
        """
        turn, shift = (part - part[:1] for part in self.twists(coefficients, poses))
        shift = shift - skew(poses[:, :3, 3]) @ turn
        to_first = poses[0, :3, :3].T
        return np.concatenate([to_first @ shift, to_first @ turn], axis=1)

    def _accumulate(self, per_frame: FloatArray) -> FloatArray:
        per_coefficient = per_frame[:, :, self._columns, None] * self.basis[:, None, :, :]
        return np.asarray(np.cumsum(per_coefficient, axis=0).reshape(len(per_frame), 3, -1))


def correction_matrices(values: FloatArray) -> FloatArray:
    """Equation (2): matrices of corrections (x, y, z, tilt, yaw, roll), shape (n, 6) to (n, 4, 4)."""
    matrices = np.zeros((len(values), 4, 4))
    matrices[:, :3, :3] = rotation_from_fixed_angles(values[:, 5], values[:, 4], values[:, 3]).as_matrix()
    matrices[:, :3, 3] = values[:, :3]
    matrices[:, 3, 3] = 1.0
    return matrices


def _world_axes(poses: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Twist in the world of each of a frame's six corrections, as columns: turn and shift, (n, 3, 6)."""
    rotation = correction_matrices(values)[:, :3, :3]
    before = poses[:, :3, :3] @ rotation.transpose(0, 2, 1)
    # Tilt, yaw and roll turn Rz(roll) Ry(yaw) Rx(tilt) about its own x, the y before it, and z.
    axes, roll = np.zeros((len(poses), 3, 3)), values[:, 5]
    axes[:, :, 0], axes[:, 0, 1], axes[:, 1, 1] = rotation[:, :, 0], -np.sin(roll), np.cos(roll)
    axes[:, 2, 2] = 1.0
    turn = before @ axes
    # The turn is about the frame's own origin p: w x (X - p) = w x X + p x w.
    about_origin = skew(poses[:, :3, 3]) @ turn
    return np.dstack([np.zeros_like(turn), turn]), np.dstack([before, about_origin])
