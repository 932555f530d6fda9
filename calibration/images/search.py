"""Search of a box of calibrations about a rough start, from coarse to fine.

Many places are looked at at a coarse resolution, and the best of them followed up by Gauss-Newton at finer
and finer ones.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import qmc

from calibration.images.fit import Fit, refine
from calibration.images.similarity import CrossingSweeps, Level
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
    centre_mm, far_mm = (
        crossing.centre_mm,
        1.2 * np.sqrt(3.0) * np.hypot(capture_mm, 20.0 * capture_rad) + 1.0,
    )

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
