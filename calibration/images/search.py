"""Search of a box of calibrations about a rough start, and Gauss-Newton on the correlation of patches.

Many places are looked at at a coarse resolution, and the best of them followed up by Gauss-Newton at finer
and finer ones.

The patch and its cut, both without their mean and of unit length, differ by a vector whose squared length is
2 (1 - correlation); its derivative gives Gauss-Newton its matrix, and the exact derivative of the correlation
its gradient. A patch that stays unlike, or has little structure, counts less (Geman and McClure).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import qmc

from calibration.images.similarity import Comparison, CrossingSweeps, Level, Similarity, step_pose
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.progress import Progress
from speckle3d.core.threads import ahead

GLANCE = Level(4.0, images=6, side=5, overlap=0.0, least_weight=0.45)
FOLLOW_UP = Level(3.0, images=8, side=5, least_weight=0.45)
COMPARISON = Level(2.0, images=8)
DECISION = Level(1.2, images=8, overlap=0.25)

_GLANCES = 1024
"""Places compared first: about one in a thousand of +-20 mm and +-20 degrees lies in Gauss-Newton's reach,
but slopes that lead there start much farther out."""

_MORE_GLANCES = 4096
"""Places compared if none of those led to an answer: the right one may lie in a corner of the box."""

_MOST_FOLLOW_UPS, _MOST_COMPARISONS, _MOST_DECISIONS = 20, 5, 3

_STEPS = 12

_SAME_MM = 1.5


def search(
    crossing: CrossingSweeps,
    start: RigidTransform,
    capture_mm: float,
    capture_rad: float,
    progress: Progress | None = None,
) -> list[RigidTransform]:
    """Search a box of six parameters about the start, from coarse to fine; the best places, best first.

    Raises
    ------
    InsufficientDataError
        If the sweeps show nothing in common anywhere.
    """
    # As far as the box's corners, and a fifth more.
    far_mm = 1.2 * np.sqrt(3.0) * np.hypot(capture_mm, 20.0 * capture_rad) + 1.0
    centre_mm = crossing.centre_mm

    def best_of(count: int, most: int) -> list[RigidTransform]:
        """The best of many places in the box: those from which an increment leads to the start."""
        places = 2.0 * qmc.Sobol(6, rng=1).random(count) - 1.0
        places[0] = 0.0
        turn = Rotation.from_euler("xyz", capture_rad * places[:, :3])
        away = RigidTransform.from_components(capture_mm * places[:, 3:], turn)
        poses = list(start * away.inv())
        comparison, scores = crossing.level(GLANCE, start), np.empty(count)
        for n, score in enumerate(ahead(lambda place: comparison.at(place).score, poses)):
            scores[n] = score
            if progress is not None:
                progress(n + 1, count)
        return [poses[int(n)] for n in np.argsort(-scores)[:most] if scores[n] > -1]

    def refine_all(level: Level, starts: list[RigidTransform]) -> list[Fit]:
        """Refine each start, best first."""
        if not starts:
            return []
        comparison = crossing.level(level, starts[0])
        ends = ahead(lambda place: refine(comparison, place, max_steps=_STEPS), starts)
        return sorted(ends, key=lambda end: -end.similarity.score)

    ends: list[Fit] = []
    for count, most in ((_GLANCES, _MOST_FOLLOW_UPS), (_MORE_GLANCES, 2 * _MOST_FOLLOW_UPS)):
        if not ends:
            best = best_of(count, most)
            ends = refine_all(FOLLOW_UP, best)
            ends = [end for end in ends if distance_mm(end.sensor_from_image, start, centre_mm) <= far_mm]
    if not ends:
        result = "none but farther off" if best else "no overlap anywhere"
        raise InsufficientDataError(
            f"expected sweeps that agree within {capture_mm:g} mm and {np.rad2deg(capture_rad):g} degrees "
            f"of the start, got {result}"
        )
    for level, most in ((COMPARISON, _MOST_COMPARISONS), (DECISION, _MOST_DECISIONS)):
        ends = refine_all(level, _distinct(ends, centre_mm)[:most])
    return _distinct(ends, centre_mm)


def _distinct(ends: list[Fit], centre_mm: FloatArray) -> list[RigidTransform]:
    """Places without those within `_SAME_MM` of a better one."""
    places: list[RigidTransform] = []
    for end in ends:
        if all(distance_mm(end.sensor_from_image, place, centre_mm) > _SAME_MM for place in places):
            places.append(end.sensor_from_image)
    return places


def distance_mm(first: RigidTransform, second: RigidTransform, centre_mm: FloatArray) -> float:
    """Distance between calibrations, mm: of the image's centre and of points that turn 20 mm away from it."""
    step = second.inv() * first
    shift = float(np.linalg.norm(step.apply(centre_mm) - centre_mm))
    return float(np.hypot(shift, 20.0 * step.rotation.magnitude()))


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
    return np.where(valid, structure * (ROBUST / (ROBUST + unlike)) ** 2, 0.0)


def is_better(trial: Similarity, best: Similarity, weight: FloatArray) -> bool:
    """Whether patches supported at both places correlate better; others would reward losing bad patches."""
    valid = best.valid & trial.valid
    gain = weight[valid] @ (trial.alike[valid] - best.alike[valid])
    return bool(gain > 0 and valid.sum() >= 0.5 * best.valid.sum())
