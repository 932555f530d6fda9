"""Gauss-Newton on the correlation of patches, Newton's last steps, and the covariance of the answer.

The patch and its cut, both without their mean and of unit length, differ by a vector whose squared length is
2 (1 - correlation); its derivative gives Gauss-Newton its matrix, and the exact derivative of the correlation
its gradient. A patch that stays unlike, or has little structure, counts less (Geman and McClure).

Gauss-Newton's matrix is made of the images' squared slopes, in which the slopes of speckle count in full
although the similarity does not fall off by them: where speckle is strong it is several times too stiff, its
steps too short, and errors made from it too small. Differences of the exact slopes are free of that, so they
give the last steps and the covariance.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.angulation import PARAMETERS, point_motion
from calibration.images.similarity import Comparison, Likeness
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import skew

ROBUST = 0.5
"""1 - correlation at which a patch counts a quarter of what one that is alike does."""

MAX_STEPS = 25

LEVERS_MM = np.array([30.0, 30.0, 30.0, 1.0, 1.0, 1.0, 30.0, 30.0])
"""What a turn, a displacement, and a relative change of pixel size move: the image's edge, in mm."""

SETTLED = 2e-3
"""Step of the image's edge, mm, at which to stop: a hundredth of what speckle lets be known."""

APART_MM = 0.3
"""How far the image's edge is moved to either side for a difference: less than the blur of speckle."""

LEAST_CURVATURE = 0.02
"""Of Gauss-Newton's, what a direction keeps in which the similarity hardly falls, or rises; in scenes that
tell it is 0.1 to 0.7. Errors along it are then so large that it is seen to be open."""

_MOST_STEPS, _LONGEST_MM = 8, 1.0
"""Steps, and how far one may move the image's edge: beyond the blur of speckle the curvature is another."""

BLOCK_MM = 16.0
"""Side of the blocks of tissue that err together, in units of the images' size: some patches wide, as
neighbours see the same reflections."""

STRETCH = 3
"""Images compared that err together: a tracker's error lasts from one to the next."""

SHARED_RAD = np.deg2rad(0.1)
SHARED_MM = (0.03, 0.1, 0.04)
"""Standard deviations, turns and displacements of the image's centre across, along the beam and out of plane,
of what all of the tissue shares and no part of it can show: root mean squares of what was left over six
simulated pairs of sweeps, whatever the start. A thick beam shows what is beside it deeper than it is."""

NAMES = (*PARAMETERS, "lateral pixel size", "axial pixel size")


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


@dataclass(frozen=True)
class Spread:
    """Covariance of turns, displacements and relative pixel sizes at the image's origin, shape (8, 8)."""

    covariance: FloatArray
    condition_number: float
    weakest: str


def covariance_at_origin(settled: Settled, unit: float) -> Spread:
    """Sandwich of the curvature and of how slopes differ between blocks of tissue and stretches of sweeps.

    What differs from block to block of tissue (speckle, reflections) and from image to image (poses) adds up.
    Poses count twice: those of the images compared, and those of the images cut, of which there are as many.
    What all of the tissue shares is added (`SHARED_MM`).

    Parameters
    ----------
    unit : float
        Size of the images relative to the usual.

    References
    ----------
    .. [1] P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 5th
       Berkeley Symposium on Mathematical Statistics and Probability, 1967.
    """
    refined = settled.refined
    chosen = np.array(refined.free)
    base = about_pivot(refined.pivot_mm)[:, chosen]
    slopes = (refined.weight[:, None] * refined.likeness.gradient) @ base
    norms = np.sqrt(np.diag(settled.curvature))
    values, vectors = np.linalg.eigh(settled.curvature / np.outer(norms, norms))
    condition = float(np.sqrt(values[-1] / max(values[0], 1e-300)))
    tissue = _scatter(slopes, _numbered(np.floor(refined.places_mm / (BLOCK_MM * unit))))
    poses = _scatter(slopes, _numbered(np.column_stack(_stretches(refined))))
    moved = base @ np.linalg.inv(settled.curvature)
    covariance = moved @ (tissue + 2.0 * poses) @ moved.T + _shared(refined.pivot_mm, unit)
    return Spread(covariance, condition, NAMES[chosen[np.argmax(np.abs(vectors[:, 0]))]])


def _shared(pivot_mm: FloatArray, unit: float) -> FloatArray:
    """Covariance at the origin of what no part of the tissue can show; pixel sizes have none."""
    variance = np.concatenate([np.full(3, SHARED_RAD), unit * np.array(SHARED_MM), np.zeros(2)]) ** 2
    base = about_pivot(pivot_mm)
    return np.asarray(base @ np.diag(variance) @ base.T)


def _scatter(slopes: FloatArray, cluster: IntArray) -> FloatArray:
    """Covariance of the sum of patches' slopes, if those of one cluster err together."""
    count = int(cluster.max()) + 1
    if count < 2:
        raise InsufficientDataError(
            "expected sweeps that share more tissue, got too little to compare its parts"
        )
    sums = np.zeros((count, slopes.shape[1]))
    np.add.at(sums, cluster, slopes)
    sums -= sums.mean(axis=0)
    return np.asarray(count / (count - 1.0) * sums.T @ sums)


def _numbered(cells: FloatArray) -> IntArray:
    """Number of each patch's cell, from zero."""
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1], dtype=np.int64).ravel()


def _stretches(refined: Refined) -> tuple[IntArray, IntArray]:
    """Sweep, and stretch of it, that each patch's image belongs to."""
    sweep, image = refined.comparison.images.T
    return sweep, _numbered(np.column_stack([sweep, image])) // STRETCH


def point_covariance(covariance: FloatArray, point_mm: FloatArray) -> FloatArray:
    """Covariance of a point of the image from that of its pose at the image's origin, shape (3, 3)."""
    moved = point_motion(np.asarray(point_mm, dtype=float)[None])[0]
    return np.asarray(moved @ covariance @ moved.T)
