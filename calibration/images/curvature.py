"""How fast the similarity really falls about an answer, and the last steps to it.

Gauss-Newton takes for its matrix the squared slopes of the images, of which the slopes of speckle are a part
that does not fall off as the images are moved apart: it is several times too stiff where speckle is strong.
Then its steps are too short, and errors made from it too small. Differences of the exact slopes are neither.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from calibration.images.fit import LEVERS_MM, SETTLED, Refined, about_pivot, better, weights
from speckle3d.core.arrays import FloatArray

APART_MM = 0.3
"""How far the image's edge is moved to either side for a difference: less than the blur of speckle."""

LEAST_CURVATURE = 0.02
"""Of Gauss-Newton's, what a direction keeps in which the similarity hardly falls, or rises; in scenes that
tell it is 0.1 to 0.7. Errors along it are then so large that it is seen to be open."""

_MOST_STEPS, _LONGEST_MM = 8, 1.0
"""Steps, and how far one may move the image's edge: beyond the blur of speckle the curvature is another."""


@dataclass(frozen=True)
class Settled:
    """An answer, and how fast the similarity falls about it.

    Attributes
    ----------
    curvature : ndarray, shape (f, f)
        Of the weighted similarity, by the free parameters at the pivot; positive definite.
    """

    refined: Refined
    curvature: FloatArray


def settle(refined: Refined, pool: ThreadPoolExecutor | None = None) -> Settled:
    """Newton's steps from where Gauss-Newton stopped, all with the curvature found there."""
    bend = curvature(refined, pool)
    now, converged = refined, False
    for _ in range(_MOST_STEPS):
        step = np.zeros(len(LEVERS_MM))
        step[list(now.free)] = np.linalg.solve(bend, now.system[1])
        size = float(np.abs(step * LEVERS_MM).max())
        converged = size < SETTLED
        if converged:
            break
        moved = _stepped(now, step * min(1.0, _LONGEST_MM / size), pool)
        if not better(now.likeness, moved.likeness, now.weight):
            converged = size < 10.0 * SETTLED  # no better within rounding
            break
        now = moved
    return Settled(replace(now, converged=converged), bend)


def curvature(refined: Refined, pool: ThreadPoolExecutor | None = None) -> FloatArray:
    """Differences of the similarity's slope to either side of an answer, shape (f, f)."""
    chosen, base = list(refined.free), about_pivot(refined.pivot_mm)
    found = np.empty((len(chosen), len(chosen)))
    for column, parameter in enumerate(chosen):
        slopes = []
        for sign in (1.0, -1.0):
            step = np.zeros(len(LEVERS_MM))
            step[parameter] = sign * APART_MM / LEVERS_MM[parameter]
            there = refined.estimate.stepped(step, refined.pivot_mm)
            seen = refined.comparison.at(there.sensor_from_image, there.scales, True, pool)
            weight = np.where(seen.valid, refined.weight, 0.0)
            slopes.append((base.T @ (weight @ seen.gradient))[chosen])
        found[:, column] = (slopes[1] - slopes[0]) * LEVERS_MM[parameter] / (2.0 * APART_MM)
    return _positive(found, refined.system[0])


def _stepped(refined: Refined, step: FloatArray, pool: ThreadPoolExecutor | None) -> Refined:
    estimate = refined.estimate.stepped(step, refined.pivot_mm)
    seen = refined.comparison.at(estimate.sensor_from_image, estimate.scales, True, pool)
    count = refined.evaluations + 1
    return replace(refined, estimate=estimate, likeness=seen, weight=weights(seen), evaluations=count)


def _positive(found: FloatArray, normal: FloatArray) -> FloatArray:
    """Symmetric, and in no direction less than a small part of Gauss-Newton's matrix."""
    firm = normal + 1e-9 * np.trace(normal) * np.eye(len(normal))
    part, axes = eigh((found + found.T) / 2.0, firm)
    back = firm @ axes
    return np.asarray((back * np.maximum(part, LEAST_CURVATURE)) @ back.T)
