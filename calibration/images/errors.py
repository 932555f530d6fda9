"""Claimed errors of a calibration from two sweeps: jackknife over tissue, tracker's, and fits started again.

An answer sits on a bump of speckle, where the similarity falls more steeply than it would without speckle. So
the curvature behind the standard errors is taken over displacements wider than speckle; from its place on the
bump alone, errors were claimed half as large as they were.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import RigidTransform

from calibration.images.angulation import PARAMETERS, Angulation, point_motion
from calibration.images.search import Fit, distance_mm, refine
from calibration.images.similarity import (
    Comparison,
    CrossingSweeps,
    Level,
    Similarity,
    about_pivot,
    step_pose,
)
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import skew

WIDE_MM = 1.6
"""Root mean square displacement between the sweeps, in units of the images' size, over which curvature is
taken: over twice the blur, beyond which speckle is no longer like itself. In 15 simulated pairs claims were
0.7 of the errors at 0.3 mm, 0.9 at 1 mm, 1.2 at 1.6 mm."""

_FARTHEST = np.array([0.25, 0.25, 0.25, 5.0, 5.0, 5.0])
"""Largest steps, rad and mm: of an error that hardly shows no step would be wide enough."""

LEAST_CURVATURE = 0.01
"""Least curvature in any direction, as a share of Gauss-Newton's. Layers have 0.01 to 0.06, other tissue 0.07
and more: below, the standard errors are so large that the answer is refused."""

BLOCK_MM = 10.0
"""Side of the blocks of tissue whose patches have correlated errors, in units of the images' size: two
patches, since neighbours show the same speckle and reflections."""

WANDERS = 1.0
"""Time over which a tracker's error is like itself, in lengths of a sweep: seconds."""

DEEP_MM = 0.1
"""Standard deviation of a displacement along the beam that all of the tissue shares, so that no differences
between its parts show it, in units of the images' size: a thick beam displays echoes from beside the image
plane too deep. The root mean square over six simulated pairs of sweeps."""

RESTART = Level(1.0, images=8, overlap=0.25)
"""Resolution of the fits started again: at finer ones speckle holds them halfway for tens of steps."""
_RESTART_STEPS = 14
_BESIDE_DEG, _BESIDE_MM = 2.0, 1.5
"""Turns about the image's centre and displacements, in units of the images' size, from which fits start
again: over speckle's size, and within reach of the fit."""
_SIDES = np.array([[1, 1, 1, 1, 1, 1], [1, -1, 1, -1, -1, 1]])
"""Signs of turns and displacements; each side has its opposite."""

MOST = np.array([2.5, 2.5, 2.5, 1.0, 1.0, 1.0])
"""Largest standard errors of the image's centre and turns: 95 % intervals of 2 mm, within which the published
method agreed with phantoms in vivo (Wein and Khamene 2008), and 5 degrees. It agreed within 4 degrees;
simulated sweeps of good motion over tissue of low contrast claim up to 2.1 degrees of standard error."""

LEAST_SIMILARITY = 0.3
"""Correlation of patches where speckle is blurred away, times the root of the share of them with support,
below which sweeps are taken to show too little in common. Of sweeps of different tissue the best found is
0.1 to 0.2; of the same, 0.35 in the heaviest speckle and shadow tried, to 0.9."""

RIVAL_MM, CLEAR_LEAD = 3.0, 0.02
"""Distance at which another place found by the search is another answer and not the same one unrefined; and
the lead in correlation that an answer must have: twice what varies between answers from different starts."""


def curvature_of(fit: Fit, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Curvature of each patch's weighted correlation, (p, 6, 6), and of all, (6, 6), over steps either way.

    By differences of the exact slopes; Gauss-Newton's matrix, in which the slopes of speckle count in full,
    is several times too stiff.
    """
    pivot_mm, columns = fit.comparison.pivot_mm, []
    for parameter, step in enumerate(np.diag(steps)):
        places = (step_pose(fit.sensor_from_image, sign * step, pivot_mm) for sign in (-1.0, 1.0))
        sides = [fit.comparison.at(place, True) for place in places]
        columns.append(_slope_difference(fit, sides) / (2.0 * steps[parameter]))
    bends = np.stack(columns, axis=2)
    return bends, positive(bends.sum(axis=0), fit.system[0])


def covariance_of(
    fit: Fit, crossing: CrossingSweeps, tracker: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Covariance of an answer's turns and displacements at the image's origin, (6, 6).

    Errors of tissue (speckle, reflections) and of poses are told by how the answer changes when one block of
    tissue after another is left out. An error of the tracker that lasts for
    seconds displaces one sweep against the other and shows in no such change; its effect is computed. To
    their sum comes the scatter of fits started beside the answer.

    Parameters
    ----------
    tracker : tuple of float
        Standard deviation of what the tracker displaces and turns one sweep against the other by, on each
        axis, mm and rad.

    Returns
    -------
    covariance : ndarray, shape (6, 6)
    curvature : ndarray, shape (6, 6)
        Of the similarity over more than speckle's width.

    References
    ----------
    .. [1] A. C. Cameron and D. L. Miller, "A practitioner's guide to cluster-robust inference", Journal of
       Human Resources, 2015 (the jackknife over clusters).
    """
    unit, base = crossing.unit, about_pivot(fit.comparison.pivot_mm)
    # How far an error of one moves sweeps at right angles apart: a shift across or out of the image, root 2.
    stiff, wide = np.diag(fit.system[0]), unit * WIDE_MM
    shows = 2.0 * np.sqrt(stiff / (stiff[3] + stiff[5]))
    bends, curvature = curvature_of(fit, np.minimum(wide / np.maximum(shows, 1e-6), _FARTHEST))
    slopes = fit.weight[:, None] * fit.similarity.gradient
    cells = np.floor(fit.places_mm / (BLOCK_MM * unit))
    blocks = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    inverse, variance = np.linalg.inv(curvature), np.repeat(np.square(tracker), 3)
    wander = inverse @ _wandering(fit, _pulls(fit, wide), variance) @ inverse.T
    covariance = base @ (_jackknife(slopes, bends, blocks, curvature) + wander) @ base.T
    covariance[4, 4] += (DEEP_MM * unit) ** 2
    covariance += _scatter(fit, crossing)
    return np.asarray(covariance), curvature


def require_accuracy(covariance: FloatArray, angulation: Angulation, centre_mm: FloatArray) -> None:
    """Refuse an answer whose claimed errors are too large to be of use.

    Raises
    ------
    InsufficientDataError
        With what would help: other motion, or other tissue.
    """
    motion = point_motion(centre_mm[None])[0]
    variances = np.concatenate([np.diag(covariance)[:3], np.diag(motion @ covariance @ motion.T)])
    errors = np.sqrt(variances) * np.repeat([np.rad2deg(1.0), 1.0], 3)
    worst = int(np.argmax(errors / MOST))
    if errors[worst] <= MOST[worst]:
        return
    sufficient, unit = angulation.verdict == "sufficient", "degrees" if worst < 3 else "mm"
    help_by = "scan tissue with more structure in all directions" if sufficient else angulation.advice
    raise InsufficientDataError(
        f"expected sweeps that tell {PARAMETERS[worst]} to {MOST[worst]:g} {unit} (standard error), got "
        f"{errors[worst]:.1f} {unit}; {help_by}"
    )


def require_one_answer(comparison: Comparison, answer: RigidTransform, rivals: list[RigidTransform]) -> None:
    """Refuse an answer if another that the search found, far from it, is as good for all that is known.

    Raises
    ------
    InsufficientDataError
        Saying how far off the other is.
    """
    score = comparison.at(answer).score
    for rival in rivals:
        away, rival_score = distance_mm(rival, answer, comparison.pivot_mm), comparison.at(rival).score
        if away >= RIVAL_MM and rival_score >= max(LEAST_SIMILARITY, score - CLEAR_LEAD):
            raise InsufficientDataError(
                f"expected one mounting that fits the sweeps best, got another {away:.0f} mm from it that "
                f"fits as well (correlation {rival_score:.3f} and {score:.3f}): tissue with more structure, "
                "or a better start with a smaller --capture-mm, would tell them apart"
            )


def _scatter(fit: Fit, crossing: CrossingSweeps) -> FloatArray:
    """Mean square of how far fits that start beside the answer end from one that starts at it, shape (6, 6).

    An answer sits on a bump of speckle, and others may be near: where fits end elsewhere, it is in doubt.
    """
    comparison = crossing.level(RESTART, fit.sensor_from_image)
    beside = np.repeat([np.deg2rad(_BESIDE_DEG), _BESIDE_MM * crossing.unit], 3)
    ends = []
    for side in np.concatenate([np.zeros((1, 6)), _SIDES, -_SIDES]):
        start = step_pose(fit.sensor_from_image, side * beside, comparison.pivot_mm)
        ends.append(refine(comparison, start, _RESTART_STEPS).sensor_from_image)
    steps = [ends[0].inv() * end for end in ends[1:]]
    moves = np.array([np.append(step.rotation.as_rotvec(), step.translation) for step in steps])
    return np.asarray(moves.T @ moves / (len(moves) - 1))


def _pulls(fit: Fit, step_mm: float) -> FloatArray:
    """How each patch's slopes change as the second sweep is displaced along the world's axes, (p, 6, 3)."""
    first, second = fit.comparison.stacks
    columns = []
    for axis in np.eye(3):
        sides = []
        for sign in (-1.0, 1.0):
            world = RigidTransform.from_translation(sign * step_mm * axis) * second.world_from_sensor
            stacks = first, replace(second, world_from_sensor=world)
            sides.append(replace(fit.comparison, stacks=stacks).at(fit.sensor_from_image, True))
        columns.append(_slope_difference(fit, sides) / (2.0 * step_mm))
    return np.stack(columns, axis=2)


def _slope_difference(fit: Fit, sides: list[Similarity]) -> FloatArray:
    """Difference of the weighted slopes at two places, of patches with support throughout; zero of others."""
    valid = fit.similarity.valid & sides[0].valid & sides[1].valid
    difference = fit.weight[:, None] * (sides[0].gradient - sides[1].gradient)
    return np.where(valid[:, None], difference, 0.0)


def _wandering(fit: Fit, pulls: FloatArray, variance: FloatArray) -> FloatArray:
    """Covariance of the slope from an error of each sweep's poses that wanders over the sweep's length.

    An image's error counts where the image is compared, and as much again where it is cut.

    Parameters
    ----------
    variance : ndarray, shape (6,)
        Of displacements (mm^2) and turns (rad^2) of one sweep against the other about the tissue.
    """
    share = np.linalg.norm(pulls, axis=(1, 2))
    arms = fit.places_mm - share @ fit.places_mm / max(float(share.sum()), 1e-300)
    effects = 2.0 * np.concatenate([pulls, pulls @ -skew(arms)], axis=2)
    covariance = np.zeros((pulls.shape[1],) * 2)
    comparison = fit.comparison
    parts = np.split(effects, [len(comparison.patches[0].where)])
    for stack, patches, part in zip(comparison.stacks, comparison.patches, parts, strict=True):
        sums = np.zeros((len(stack), *effects.shape[1:]))
        np.add.at(sums, patches.where[:, 0], part)
        lag = np.arange(len(stack)) / (WANDERS * len(stack))
        alike = np.exp(-np.abs(lag[:, None] - lag))
        # Half of the variance is this sweep's.
        covariance += np.einsum("iak,ij,jbk,k->ab", sums, alike, sums, 0.5 * variance, optimize=True)
    return covariance


def _jackknife(slopes: FloatArray, bends: FloatArray, cluster: IntArray, curvature: FloatArray) -> FloatArray:
    """Jackknife over clusters: covariance by what the answer moves by when each is left out."""
    count = int(cluster.max()) + 1
    if count < 2:
        raise InsufficientDataError(
            "expected sweeps that share more tissue, got too little to compare its parts"
        )
    slope, bend = np.zeros((count, slopes.shape[1])), np.zeros((count, *curvature.shape))
    np.add.at(slope, cluster, slopes)
    np.add.at(bend, cluster, bends)
    # What remains of the tissue counts at least a fifth of the whole.
    remainders = (positive(curvature - b, curvature, 0.2) for b in bend)
    moves = np.array([np.linalg.solve(r, s) for r, s in zip(remainders, slope, strict=True)])
    moves -= moves.mean(axis=0)
    return np.asarray((count - 1.0) / count * moves.T @ moves)


def positive(matrix: FloatArray, normal: FloatArray, least: float = LEAST_CURVATURE) -> FloatArray:
    """Symmetrise, and raise to at least a share of a positive matrix in every direction."""
    firm = normal + 1e-9 * np.trace(normal) * np.eye(len(normal))
    part, axes = eigh((matrix + matrix.T) / 2.0, firm)
    back = firm @ axes
    return np.asarray((back * np.maximum(part, least)) @ back.T)
