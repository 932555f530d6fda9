"""How much to believe of a phantom's stated place: held, turned or free, by cross-validation over frames.

A registration that is good is best held, for what is not estimated cannot be wrong; one that is wrong spoils
the calibration. Frames that were left out tell: a calibration that explains them better is nearer the truth,
and one that follows the errors of its own frames is not.

References
----------
.. [1] L. Breiman, J. Friedman, C. J. Stone and R. A. Olshen, "Classification and regression trees", 1984,
   section 3.4.3 (the simplest within one standard error of the best).
.. [2] P. Burman, E. Chow and D. Nolan, "A cross-validatory method for dependent data", Biometrika 81, 1994
   (blocks in time).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.points import ImagePoints
from calibration.settings import Registration, WireFit
from calibration.solution import Solution
from calibration.wires import calibrate_wires
from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.wires import WirePhantom

REGISTRATIONS: tuple[Registration, ...] = ("held", "turned", "free")
"""Simplest first."""

FOLDS = 8
"""Blocks of successive frames, each left out once: a tracker's error wanders over seconds, and frames beside
each other would vouch for each other."""


@dataclass(frozen=True)
class Choice:
    """Which registration was chosen, and why.

    Attributes
    ----------
    missed_mm : mapping of str to float
        Mean distance of the dots of left-out frames from their wires; of the registrations that give a
        calibration.
    """

    registration: Registration
    missed_mm: Mapping[Registration, float]

    def __str__(self) -> str:
        each = ", ".join(f"{name} {missed:.3f} mm" for name, missed in self.missed_mm.items())
        return f"phantom's place {self.registration}: frames left out miss their wires by {each}"


def calibrate_registered(
    points: ImagePoints,
    geometry: WirePhantom,
    pixel_mm: FloatArray | None = None,
    settings: WireFit | None = None,
) -> tuple[Solution, Choice]:
    """Calibrate with wires whose place in the world is stated, believing as much of it as is right.

    Parameters
    ----------
    points, geometry, pixel_mm, settings
        See `calibrate_wires`.

    Raises
    ------
    InsufficientDataError
        If no registration gives a calibration; see `calibrate_wires`.
    """
    whole: dict[Registration, Solution] = {}
    refusals = []
    for name in REGISTRATIONS:
        try:
            whole[name] = calibrate_wires(points, geometry, pixel_mm, settings, name)
        except InsufficientDataError as error:
            refusals.append(error)
    if not whole:
        raise refusals[0]
    choice = choose({name: _missed_mm(solution) for name, solution in whole.items()})
    return whole[choice.registration], choice


def choose(missed_mm: Mapping[Registration, FloatArray]) -> Choice:
    """Choose the simplest that is worse than the best by at most a standard error of the difference.

    Parameters
    ----------
    missed_mm : mapping of str to ndarray, shape (blocks,)
        Simplest first.
    """
    means = {name: float(each.mean()) for name, each in missed_mm.items()}
    best = missed_mm[min(missed_mm, key=lambda name: means[name])]
    worse = {name: each - best for name, each in missed_mm.items()}
    simplest = next(
        name for name, each in worse.items() if each.mean() <= np.std(each, ddof=1) / np.sqrt(len(each))
    )
    return Choice(simplest, means)


def _missed_mm(solution: Solution) -> FloatArray:
    """Mean distance of the dots of each block of frames from their wires, by what the others say."""
    points, phantom, missed = solution.points, solution.phantom, []
    for frames in np.array_split(points.frames, FOLDS):
        out = np.isin(points.frame, frames)
        kept = phantom.equations(points[solution.used & ~out])
        chain = kept.least_squares(solution.chain, solution.free)
        left = phantom.equations(points[out]).residuals(chain)
        missed.append(float(np.linalg.norm(left, axis=1).mean()))
    return np.array(missed)
