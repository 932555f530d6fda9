"""The optimiser: Gauss-Newton on the correlation of patches.

The patch and its cut, both without their mean and of unit length, differ by a vector whose squared length is
2 (1 - correlation); its derivative gives Gauss-Newton its matrix, and the exact derivative of the correlation
its gradient. A patch that stays unlike, or has little structure, counts less (Geman and McClure).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from calibration.images.similarity import Comparison, Similarity, step_pose
from speckle3d.core.arrays import FloatArray

ROBUST = 0.5
"""1 - correlation at which a patch has a quarter of the weight of one that correlates fully."""

MAX_STEPS = 25

LEVERS_MM = np.array([30.0, 30.0, 30.0, 1.0, 1.0, 1.0])
"""How far the image's edge moves per unit of each parameter, mm."""

CLOSE_MM = 2e-3
"""Step of the image's edge, mm, at which the fit has converged: a hundredth of speckle's error."""


@dataclass(frozen=True)
class Fit:
    """Result of `refine`.

    Attributes
    ----------
    similarity : Similarity
        At the estimate, with derivatives.
    weight : ndarray, shape (p,)
        Of each patch.
    comparison : Comparison
        Where the patches come from.
    """

    sensor_from_image: RigidTransform
    similarity: Similarity
    weight: FloatArray
    comparison: Comparison
    converged: bool = False

    @property
    def places_mm(self) -> FloatArray:
        """Where in the world the patches lie, shape (p, 3)."""
        return self.comparison.places_mm(self.sensor_from_image)

    @property
    def system(self) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton's matrix and the slope of the similarity."""
        normal = np.einsum("p,pij->ij", self.weight, self.similarity.normal)
        return normal, self.weight @ self.similarity.gradient


def refine(comparison: Comparison, start: RigidTransform, max_steps: int = MAX_STEPS) -> Fit:
    """Levenberg-Marquardt steps until they are too small to matter."""

    def evaluate(pose: RigidTransform) -> Fit:
        similarity = comparison.at(pose, True)
        return Fit(pose, similarity, weights(similarity), comparison)

    best, damping = evaluate(start), 1e-2
    for _ in range(max_steps - 1):
        if best.similarity.valid.sum() < 3 or damping > 1e6:
            break
        matrix, slope = best.system
        lift = damping * np.diag(matrix) + 1e-9 * np.trace(matrix)
        step = np.asarray(np.linalg.solve(matrix + np.diag(lift), slope), dtype=np.float64)
        size = float(np.abs(step * LEVERS_MM).max())
        trial = evaluate(step_pose(best.sensor_from_image, step, comparison.pivot_mm))
        if is_better(trial.similarity, best.similarity, best.weight):
            best, damping = trial, max(0.2 * damping, 1e-5)
        else:
            damping *= 8.0
        if size < CLOSE_MM:
            return replace(best, converged=True)
    return best


def weights(similarity: Similarity) -> FloatArray:
    """Weight of each patch: its contrast, reduced where it correlates badly; zero without support."""
    valid = similarity.valid
    if not valid.any():
        return np.zeros(len(valid))
    contrast = np.sqrt(similarity.energy[:, 0] * similarity.energy[:, 1])
    usual = float(np.median(contrast[valid]))
    unlike = 1.0 - np.where(valid, similarity.alike, 1.0)
    structure = contrast / (contrast + usual)
    return np.asarray(np.where(valid, structure * (ROBUST / (ROBUST + unlike)) ** 2, 0.0))


def is_better(trial: Similarity, best: Similarity, weight: FloatArray) -> bool:
    """Whether patches supported at both places correlate better; others would reward losing bad patches."""
    valid = best.valid & trial.valid
    gain = weight[valid] @ (trial.alike[valid] - best.alike[valid])
    return bool(gain > 0 and valid.sum() >= 0.5 * best.valid.sum())
