"""Gauss-Newton on the correlation of patches, robust against those that differ from view to view.

The patch and its cut, both without their mean and of unit length, differ by a vector whose squared length is
2 (1 - correlation); its derivative gives Gauss-Newton its matrix, and the exact derivative of the correlation
its gradient. A patch that stays unlike counts less and less (Geman and McClure), one without structure too.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.similarity import Comparison, Likeness
from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import skew

ROBUST = 0.5
"""1 - correlation at which a patch counts a quarter of what one that is alike does."""

MAX_STEPS = 25

LEVERS_MM = np.array([30.0, 30.0, 30.0, 1.0, 1.0, 1.0, 30.0, 30.0])
"""What a turn, a displacement, and a relative change of pixel size move: the image's edge, in mm."""

SETTLED = 2e-3
"""Step of the image's edge, mm, at which to stop: a hundredth of what speckle lets be known."""


@dataclass(frozen=True)
class Estimate:
    """A calibration under way.

    Attributes
    ----------
    scales : ndarray, shape (2,)
        Factors on the pixel sizes, lateral and axial.
    """

    sensor_from_image: RigidTransform
    scales: FloatArray

    def stepped(self, step: FloatArray, pivot_mm: FloatArray) -> Estimate:
        """Turn about a point of the image and displace it, in the image's own frame; then rescale."""
        turn = Rotation.from_rotvec(step[:3])
        shift = pivot_mm + step[3:6] - turn.apply(pivot_mm)
        moved = self.sensor_from_image * RigidTransform.from_components(shift, turn)
        return Estimate(moved, self.scales * (1.0 + step[6:8]))


@dataclass(frozen=True)
class Refined:
    """What Gauss-Newton arrived at.

    Attributes
    ----------
    likeness : Likeness
        At the estimate, with derivatives.
    weight : ndarray, shape (p,)
        Of each patch.
    comparison : Comparison
        Where the patches come from.
    pivot_mm : ndarray, shape (3,)
        The point of the image that turns leave in place.
    free : tuple of int
        Which of the eight parameters were estimated.
    """

    estimate: Estimate
    likeness: Likeness
    weight: FloatArray
    comparison: Comparison
    pivot_mm: FloatArray
    free: tuple[int, ...]
    evaluations: int
    converged: bool

    @property
    def places_mm(self) -> FloatArray:
        """Where in the world the patches lie, shape (p, 3)."""
        return self.comparison.places_mm(self.estimate.sensor_from_image)

    @property
    def system(self) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton's matrix and the slope of the similarity, of the free parameters at the pivot."""
        chosen = np.array(self.free)
        normal, gradient = _system(self.likeness, self.weight, about_pivot(self.pivot_mm))
        return normal[np.ix_(chosen, chosen)], gradient[chosen]


def refine(
    comparison: Comparison,
    start: Estimate,
    free: tuple[int, ...] = (0, 1, 2, 3, 4, 5),
    max_steps: int = MAX_STEPS,
    pool: ThreadPoolExecutor | None = None,
) -> Refined:
    """Levenberg-Marquardt steps until they are too small to matter."""
    pivot = comparison.stacks[0].centre_mm
    base = about_pivot(pivot)
    chosen = np.array(free)

    def look(estimate: Estimate) -> Likeness:
        return comparison.at(estimate.sensor_from_image, estimate.scales, True, pool)

    estimate, here = start, look(start)
    weight = weights(here)
    damping, evaluations, converged = 1e-2, 1, False
    while evaluations < max_steps and here.valid.sum() >= 3:
        normal, gradient = _system(here, weight, base)
        matrix, slope = normal[np.ix_(chosen, chosen)], gradient[chosen]
        lift = damping * np.diag(matrix) + 1e-9 * np.trace(matrix)
        step = np.zeros(8)
        step[chosen] = np.linalg.solve(matrix + np.diag(lift), slope)
        trial = estimate.stepped(step, pivot)
        there = look(trial)
        evaluations += 1
        if better(here, there, weight):
            estimate, here, damping = trial, there, max(0.2 * damping, 1e-5)
            weight = weights(here)
        else:
            damping *= 8.0
        if np.abs(step * LEVERS_MM).max() < SETTLED:
            converged = True
            break
        if damping > 1e6:
            break
    return Refined(estimate, here, weight, comparison, pivot, free, evaluations, converged)


def weights(likeness: Likeness) -> FloatArray:
    """How much each patch counts, by its structure and by how unlike it is; zero where it does not."""
    valid = likeness.valid
    if not valid.any():
        return np.zeros(len(valid))
    contrast = np.sqrt(likeness.energy[:, 0] * likeness.energy[:, 1])
    usual = float(np.median(contrast[valid]))
    unlike = 1.0 - np.where(valid, likeness.alike, 1.0)
    structure = contrast / (contrast + usual)
    return np.asarray(np.where(valid, structure * (ROBUST / (ROBUST + unlike)) ** 2, 0.0))


def about_pivot(pivot_mm: FloatArray) -> FloatArray:
    """Changes of turns and displacements at the image's origin by those at a pivot, shape (8, 8)."""
    base = np.eye(8)
    base[3:6, :3] = skew(pivot_mm)
    return base


def _system(likeness: Likeness, weight: FloatArray, base: FloatArray) -> tuple[FloatArray, FloatArray]:
    normal = base.T @ np.einsum("p,pij->ij", weight, likeness.normal) @ base
    return normal, base.T @ (weight @ likeness.gradient)


def better(here: Likeness, there: Likeness, weight: FloatArray) -> bool:
    """Whether patches that count at both places are more alike; or the likeness would reward their loss."""
    both = here.valid & there.valid
    if both.sum() < 0.5 * here.valid.sum():
        return False
    loss = [(1.0 - one.alike[both]) / (ROBUST + 1.0 - one.alike[both]) for one in (here, there)]
    # The weight of structure alone: how unlike a patch is, is in the loss.
    base = weight[both] * ((ROBUST + 1.0 - here.alike[both]) / ROBUST) ** 2
    return bool(base @ loss[1] < base @ loss[0])
