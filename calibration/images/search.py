"""From a rough start to where the fit takes over: a box of calibrations searched from coarse to fine.

Many places are looked at at a coarse resolution, and the best of them followed up by Gauss-Newton at finer
and finer ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import qmc

from calibration.images.fit import Refined, refine
from calibration.images.similarity import Comparison, CrossingSweeps, Estimate, Level, Progress
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.threads import ahead

GLANCE = Level(4.0, images=6, side=5, overlap=0.0, least_weight=0.45)
FOLLOWED = Level(3.0, images=8, side=5, least_weight=0.45)
COMPARED = Level(2.0, images=8)
DECIDED = Level(1.2, images=8, overlap=0.25)

_GLANCES = 1024
"""Places compared first: about one in a thousand of +-20 mm and +-20 degrees lies in Gauss-Newton's reach,
but slopes that lead there start much farther out."""

_MORE_GLANCES = 4096
"""Places compared if none of those led to an answer: the right one may lie in a corner of the box."""

_BESIDE = 256
"""Places compared around each of the `_HOPPED` best, at a blur whose slopes reach a quarter of the box."""

_FOLLOWED, _COMPARED, _HOPPED, _DECIDED = 20, 5, 3, 3

_STEPS = 12

_SAME_MM = 1.5


def search(
    crossing: CrossingSweeps,
    start: Estimate,
    capture_mm: float,
    capture_rad: float,
    progress: Progress | None = None,
) -> tuple[list[Estimate], int]:
    """Search a box of six parameters about the start, from coarse to fine.

    Returns
    -------
    list of Estimate
        The best places, best first.
    int
        How many were compared.

    Raises
    ------
    InsufficientDataError
        If the sweeps show nothing in common anywhere.
    """
    box = _Box(crossing, start, capture_mm, capture_rad, progress or (lambda _stage, _done, _total: None))
    looks, followed = 0, []
    for glances in (_GLANCES, _MORE_GLANCES):
        looks += glances
        best = box.best_of(glances)
        followed = box.inside(box.refined(FOLLOWED, best, "following up"))
        if followed:
            break
    if not followed:
        got = "none but farther off" if best else "no overlap anywhere"
        raise InsufficientDataError(
            f"expected sweeps that agree within {capture_mm:g} mm and {np.rad2deg(capture_rad):g} degrees "
            f"of the start, got {got}"
        )
    compared = box.refined(COMPARED, _distinct(followed, crossing)[:_COMPARED], "comparing")
    # In layered or repetitive tissue the best place so far is often a neighbour of the right one.
    hopped = box.inside(box.beside(compared[:_HOPPED]))
    again = box.refined(COMPARED, _distinct(hopped, crossing)[:_COMPARED], "comparing")
    best_first = sorted(compared + again, key=lambda one: -one.similarity.score)
    decided = box.refined(DECIDED, _distinct(best_first, crossing)[:_DECIDED], "deciding")
    looks += _BESIDE * len(compared[:_HOPPED])
    looks += sum(one.evaluations for one in followed + compared + hopped + again + decided)
    return _distinct(decided, crossing), looks


@dataclass(frozen=True)
class _Box:
    """A box of calibrations about a start, and how to compare and refine places in it."""

    crossing: CrossingSweeps
    start: Estimate
    mm: float
    rad: float
    say: Progress

    def best_of(self, count: int) -> list[Estimate]:
        """Compare many places all over the box, and return the best."""
        places = self._spread(self.start, 1.0, count)
        glance = self.crossing.level(GLANCE, self.start.sensor_from_image)
        scores = np.empty(len(places))
        for n, score in enumerate(ahead(partial(_score, glance), places)):
            scores[n] = score
            self.say("looking around", n + 1, len(places))
        most = _FOLLOWED if count == _GLANCES else 2 * _FOLLOWED
        return [places[int(n)] for n in np.argsort(-scores)[:most] if scores[n] > -1]

    def beside(self, about: list[Refined]) -> list[Refined]:
        """Compare places around the best ones, in boxes of half the size, and refine the best found there."""
        best: list[Estimate] = []
        for number, one in enumerate(about):
            comparison = self.crossing.level(FOLLOWED, one.estimate.sensor_from_image)
            places = self._spread(one.estimate, 0.5, _BESIDE)
            scores = np.array(list(ahead(partial(_score, comparison), places)))
            chosen = np.argsort(-scores)[: _FOLLOWED // len(about)]
            best += [places[int(n)] for n in chosen if scores[n] > -1]
            self.say("looking beside", number + 1, len(about))
        return self.refined(FOLLOWED, best, "following up")

    def refined(self, level: Level, starts: list[Estimate], stage: str) -> list[Refined]:
        """Refine each start, best first."""
        if not starts:
            return []
        comparison = self.crossing.level(level, starts[0].sensor_from_image)
        done = []
        for one in ahead(lambda start: refine(comparison, start, max_steps=_STEPS), starts):
            done.append(one)
            self.say(stage, len(done), len(starts))
        return sorted(done, key=lambda one: -one.similarity.score)

    def inside(self, found: list[Refined]) -> list[Refined]:
        """Keep those within 1.2 times the distance of the box's corners from the start."""
        far, kept = np.sqrt(3.0) * 1.2, []
        for one in found:
            step = one.estimate.sensor_from_image.inv() * self.start.sensor_from_image
            length, angle = np.linalg.norm(step.translation), step.rotation.magnitude()
            if length <= far * self.mm + 1.0 and angle <= far * self.rad + 0.02:
                kept.append(one)
        return kept

    def _spread(self, about: Estimate, part: float, count: int) -> list[Estimate]:
        """A place, and a Sobol sequence of those from which an increment in part of the box leads to it."""
        places = 2.0 * qmc.Sobol(6, rng=1).random(count) - 1.0
        places[0] = 0.0
        turn = Rotation.from_euler("xyz", part * self.rad * places[:, :3])
        away = RigidTransform.from_components(part * self.mm * places[:, 3:], turn)
        return [Estimate(place, about.scales) for place in about.sensor_from_image * away.inv()]


def _score(comparison: Comparison, place: Estimate) -> float:
    return comparison.at(place).score


def _distinct(found: list[Refined], crossing: CrossingSweeps) -> list[Estimate]:
    """Estimates without those within `_SAME_MM` of a better one."""
    kept: list[Estimate] = []
    for one in found:
        if all(apart_mm(one.estimate, other, crossing.centre_mm) > _SAME_MM for other in kept):
            kept.append(one.estimate)
    return kept


def apart_mm(one: Estimate, other: Estimate, centre_mm: FloatArray) -> float:
    """Distance between estimates, mm: of the image's centre and of points that turn 20 mm away from it."""
    step = other.sensor_from_image.inv() * one.sensor_from_image
    moved = float(np.linalg.norm(step.apply(centre_mm) - centre_mm))
    return float(np.hypot(moved, 20.0 * step.rotation.magnitude()))
