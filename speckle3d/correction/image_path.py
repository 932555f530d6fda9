"""The images' path, and the corrections of its steps that the images' errors allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.poses import (
    ERROR_STEPS,
    HELD,
    SCALE_CHANGE_MM,
    SHARED,
    SIDEWAYS,
    SIDEWAYS_BY_SHARE,
    STRUCTURE,
    TURN_CHANGE_MM,
    RelativePoses,
)
from speckle3d.core.reconstruction import SharedErrors
from speckle3d.correction.curves import AXES, CorrectedChain
from speckle3d.correction.scale import ScaleEvidence

FRAMES_PER_KNOT = 4
"""Corrections change from knot to knot: the images' own detail is finer than any sensor's between them. Half
of it moves lengths of five sweeps, each with three sets of sensors, by at most 0.4 %, claims by 12 %."""
HAND_TURN_RAD = float(np.deg2rad(1.0))
"""How far a scanning hand tilts and yaws in a second, deviation of a random walk: over tissue images see none
of it. Three freehand sweeps of the PLUS library turn by 0.4 to 1.6 degrees in a second. Halved and doubled it
moves lengths beside made trackers by up to 0.8 and 1.7 %, claims by factors of 0.81 to 1.45."""
Z = AXES.index("z")


def knot_intervals(frames: int) -> int:
    """Number of intervals between knots of a sweep of so many frames."""
    return int(np.clip((frames - 1) // FRAMES_PER_KNOT, 1, ERROR_STEPS))


@dataclass(frozen=True)
class ImagePath:
    """The images' path about the image's centre, and how its steps may be corrected.

    The correction of step f in each of (x, y, z, tilt, yaw, roll) is ``rate * step_mm[f]`` plus the step's
    share of an increment of its own between two knots; see `CorrectedChain` for what it does to the path.

    Attributes
    ----------
    chain : CorrectedChain
        With k + 1 coefficients for each axis: the rate, per mm of the images, and k increments.
    sigma : ndarray, shape (6, k + 1)
        Standard deviations of the coefficients before any sensor is read.
    step_mm : ndarray, shape (n,)
        Elevational step into each frame.
    """

    chain: CorrectedChain
    sigma: FloatArray
    step_mm: FloatArray

    @classmethod
    def of(
        cls,
        edges: RelativePoses,
        path: RigidTransform,
        share: float,
        shared: SharedErrors,
        frame_time_s: FloatArray,
    ) -> ImagePath:
        """Allow what the covariances of the edges and the images' common errors do.

        Parameters
        ----------
        path : RigidTransform, length n
            About the image's centre; the first is the identity.
        share : float
            Mean share of echoes that stay from frame to frame.
        shared : SharedErrors
            What all distances have wrong together.
        frame_time_s : ndarray, shape (n,)
        """
        n = len(path)
        step = np.concatenate([[0.0], (path[:-1].inv() * path[1:]).translation[:, Z]])
        knots = np.linspace(0, n - 1, knot_intervals(n) + 1).astype(int)
        interval = np.searchsorted(knots, np.arange(1, n), "left") - 1
        length = np.abs(step[1:]) + np.finfo(float).eps
        travel = np.bincount(interval, length)
        basis = np.zeros((n, 6, knots.size))
        basis[np.arange(1, n), :, interval + 1] = (length / travel[interval])[:, None]
        basis[:, :5, 0] = step[:, None]
        yaw, tilt = shared.turn_sigma_per_mm
        x, y = SIDEWAYS + SIDEWAYS_BY_SHARE * share
        density = SCALE_CHANGE_MM * np.square([x, y, shared.scale_sigma, 0.0, 0.0, 0.0])
        density[3:5] = TURN_CHANGE_MM * np.square([tilt, yaw])
        sigma = np.ones((6, knots.size))
        sigma[:5, 0] = x, y, shared.length_sigma, tilt, yaw
        scatter = np.square(SHARED * (1.0 + STRUCTURE * share))[:, None] * _knot_variances(edges, knots, n)
        sigma[:, 1:] = np.sqrt(scatter + density[:, None] * travel)
        sigma[3:5, 1:] = np.hypot(sigma[3:5, 1:], HAND_TURN_RAD * np.sqrt(np.diff(frame_time_s[knots])))
        return cls(CorrectedChain.of(path, AXES, basis), sigma, step)

    def prior(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients over their deviations, and derivatives; of the scale's rate the logarithm counts."""
        sigma, value, scale = self.sigma.ravel(), coefficients.copy(), self.scale
        slope = 1.0 / sigma
        value[scale] = np.log1p(coefficients[scale])
        slope[scale] /= 1.0 + coefficients[scale]
        return value / sigma, np.diag(slope)

    @property
    def scale(self) -> int:
        """Index of the scale's rate among the coefficients."""
        return int(Z * self.sigma.shape[1])

    @property
    def outward(self) -> FloatArray:
        """Sign of each frame's part in the way to the farthest frame and back, shape (n,)."""
        return np.where(np.arange(self.step_mm.size) <= np.argmax(np.abs(np.cumsum(self.step_mm))), 1.0, -1.0)

    def mean_rates(self) -> FloatArray:
        """Corrections of z, tilt and yaw per mm, there and back, by coefficient, shape (3, c)."""
        rows = np.zeros((3, *self.sigma.shape))
        for row, axis in enumerate((2, 3, 4)):
            rows[row, axis] = self.outward @ self.chain.basis[:, axis] / (self.outward @ self.step_mm)
        return rows.reshape(3, -1)

    def misfit(self, coefficients: FloatArray, evidence: ScaleEvidence) -> tuple[FloatArray, FloatArray]:
        """Residuals, of unit variance, of the mean scale and turns as a crossing sweep has them."""
        rows = self.mean_rates()
        mean = rows @ coefficients
        size, axes = np.linalg.eigh(evidence.information)
        root = np.sqrt(np.maximum(size, 0.0))[:, None] * axes.T
        error = np.array([np.log1p(mean[0]), *mean[1:] / (1.0 + mean[0])]) - evidence.values
        return root @ error, root @ rows / (1.0 + mean[0])


def _knot_variances(edges: RelativePoses, knots: IntArray, frames: int) -> FloatArray:
    """Variances of motion from knot to knot, each component by itself and pairs independent, shape (6, k)."""
    frame_numbers = np.arange(frames)
    ends = np.concatenate([edges.first, frame_numbers[:-1], edges.second, frame_numbers[1:]])
    size = ends.size // 2
    sign, rows = np.repeat([-1.0, 1.0], size), np.tile(np.arange(size), 2)
    difference = sparse.csr_matrix((sign, (rows, ends)), (size, frames))[:, 1:]
    between = np.zeros((frames, knots.size - 1))
    between[knots[1:], np.arange(knots.size - 1)] += 1.0
    between[knots[:-1], np.arange(knots.size - 1)] -= 1.0
    variances = []
    for axis in range(6):
        weight = 1.0 / edges.covariance[:, axis, axis]
        information = np.concatenate([weight, np.full(frames - 1, HELD[axis] ** -2)])
        factor = splu((difference.T @ sparse.diags(information) @ difference).tocsc())
        variances.append((between[1:] * factor.solve(between[1:])).sum(axis=0))
    return np.array(variances)
