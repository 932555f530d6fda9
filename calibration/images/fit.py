"""Gauss-Newton on the correlation of patches, and Newton's last steps.

The patch and its cut, both without their mean and of unit length, differ by a vector whose squared length is
2 (1 - correlation); its derivative gives Gauss-Newton its matrix, and the exact derivative of the correlation
its gradient. A patch that stays unlike, or has little structure, counts less (Geman and McClure).

Gauss-Newton's matrix is made of the images' squared slopes, in which the slopes of speckle count in full
although the similarity does not fall off by them: where speckle is strong it is several times too stiff, its
steps too short. Differences of the exact slopes are free of that, so they give the last steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibration.images.similarity import Comparison, Estimate, Similarity
from speckle3d.core.arrays import FloatArray
from speckle3d.core.geometry import skew

ROBUST = 0.5
"""1 - correlation at which a patch has a quarter of the weight of one that correlates fully."""

MAX_STEPS = 25

LEVERS_MM = np.array([30.0, 30.0, 30.0, 1.0, 1.0, 1.0, 30.0, 30.0])
"""How far the image's edge moves per unit of each parameter, mm."""

SETTLED = 2e-3
"""Step of the image's edge, mm, at which the fit has converged: a hundredth of speckle's error."""

_MOST_STEPS, _LONGEST_MM, _SHORTER = 8, 1.0, 3
"""Steps, how far one may move the image's edge, mm, since over speckle's blur the curvature changes, and how
often a step that makes things worse is shortened to a quarter."""


@dataclass(frozen=True)
class Refined:
    """Result of `refine`.

    Attributes
    ----------
    similarity : Similarity
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
    similarity: Similarity
    weight: FloatArray
    comparison: Comparison
    pivot_mm: FloatArray
    free: tuple[int, ...]
    evaluations: int = 0
    converged: bool = False

    @property
    def places_mm(self) -> FloatArray:
        """Where in the world the patches lie, shape (p, 3)."""
        return self.comparison.places_mm(self.estimate.sensor_from_image)

    @property
    def system(self) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton's matrix and the slope of the similarity, of the free parameters at the pivot."""
        chosen = np.array(self.free)
        normal, gradient = _system(self.similarity, self.weight, about_pivot(self.pivot_mm))
        return normal[np.ix_(chosen, chosen)], gradient[chosen]


def refine(
    comparison: Comparison,
    start: Estimate,
    free: tuple[int, ...] = (0, 1, 2, 3, 4, 5),
    max_steps: int = MAX_STEPS,
    share: bool = False,
) -> Refined:
    """Levenberg-Marquardt steps until they are too small to matter."""
    pivot = comparison.stacks[0].centre_mm
    base = about_pivot(pivot)
    chosen = np.array(free)

    def look(estimate: Estimate) -> Similarity:
        return comparison.at(estimate, True, share)

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


def about_pivot(pivot_mm: FloatArray) -> FloatArray:
    """Derivative of the parameters at the image's origin with respect to those at a pivot, shape (8, 8)."""
    base = np.eye(8)
    base[3:6, :3] = skew(pivot_mm)
    return base


def _system(similarity: Similarity, weight: FloatArray, base: FloatArray) -> tuple[FloatArray, FloatArray]:
    normal = base.T @ np.einsum("p,pij->ij", weight, similarity.normal) @ base
    return normal, base.T @ (weight @ similarity.gradient)


def better(here: Similarity, there: Similarity, weight: FloatArray) -> bool:
    """Whether patches supported at both places correlate better; others would reward losing bad patches."""
    both = here.valid & there.valid
    if both.sum() < 0.5 * here.valid.sum():
        return False
    loss = [(1.0 - one.alike[both]) / (ROBUST + 1.0 - one.alike[both]) for one in (here, there)]
    # The weight of contrast alone, since the loss accounts for the correlation.
    base = weight[both] * ((ROBUST + 1.0 - here.alike[both]) / ROBUST) ** 2
    return bool(base @ loss[1] < base @ loss[0])


def settle(refined: Refined, curvature: FloatArray, share: bool = False) -> Refined:
    """Take Newton steps from where Gauss-Newton stopped, all with one curvature, shape (f, f)."""
    now, converged = refined, False
    for _ in range(_MOST_STEPS):
        step = np.zeros(len(LEVERS_MM))
        step[list(now.free)] = np.linalg.solve(curvature, now.system[1])
        size = float(np.abs(step * LEVERS_MM).max())
        step *= min(1.0, _LONGEST_MM / size) if size > 0.0 else 1.0
        for _ in range(_SHORTER):
            moved = _stepped(now, step, share)
            if size < SETTLED or better(now.similarity, moved.similarity, now.weight):
                break
            step /= 4.0
        else:
            converged = size < 10.0 * SETTLED  # no better within rounding
            break
        now = moved
        if size < SETTLED:
            converged = True
            break
    return replace(now, converged=converged)


def _stepped(refined: Refined, step: FloatArray, share: bool) -> Refined:
    estimate = refined.estimate.stepped(step, refined.pivot_mm)
    seen = refined.comparison.at(estimate, True, share)
    count = refined.evaluations + 1
    return replace(refined, estimate=estimate, similarity=seen, weight=weights(seen), evaluations=count)
