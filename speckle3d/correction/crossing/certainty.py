"""How far the answer may be off, by how parts of the tissue disagree, and whether it may be believed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.correction.crossing.path import BENDS, Path
from speckle3d.correction.crossing.refine import Prior, Refined
from speckle3d.correction.crossing.similarity import PARAMETERS, RIGID, Textured

CELL_MM = 6.0
"""Side of the parts of tissue that are taken to err independently."""

FACES = 0.0045
"""Relative standard deviation of the scale by what local means do at the faces of the sweeps, where they know
the inner side alone: of simulated pairs with exact poses +0.6 % over tissue with broad patches (-0.2 % with
2.5 mm of each face left out, but twice the scatter), 0.0 % over the RF simulator's finer texture."""


def covariance(refined: Refined, prior: Prior) -> FloatArray:
    """Covariance of all parameters, shape (20, 20).

    The images' curvature says how the answer moves with the residuals; what the parts of the tissue pull by
    says how much residuals vary.
    """
    _, stiffness, _ = prior.pull(refined.placing)
    inverse = np.linalg.inv(refined.matrix + stiffness)
    pulls = _pulls(refined)
    parts = len(pulls)
    scatter = pulls.T @ pulls * parts / max(parts - 1, 1)
    found = inverse @ (scatter + stiffness) @ inverse
    scales = [bend_slice(which).start for which in (0, 1)]
    found[scales, scales] += FACES**2
    return np.asarray(found)


def _pulls(refined: Refined) -> FloatArray:
    """What each part of the tissue pulls the parameters by, shape (parts, 20)."""
    cells, pulls = [], []
    for way in refined.ways:
        residuals, rows = way.residuals(way.valid)
        pulls.append(refined.weight * rows * residuals[:, None])
        cells.append(np.floor(way.points_mm[way.valid] / CELL_MM).astype(int))
    number: IntArray = np.unique(np.concatenate(cells), axis=0, return_inverse=True)[1].ravel()
    sums = np.zeros((int(number.max()) + 1, PARAMETERS))
    np.add.at(sums, number, np.concatenate(pulls))
    return sums


def angle_deg(refined: Refined) -> float:
    """Angle between the directions in which both sweeps' images run across, 0 to 90 degrees."""
    across = refined.placing.first_from_second.rotation.as_matrix()[:, 0]
    return float(np.rad2deg(np.arccos(min(1.0, abs(float(across[0]) / np.hypot(across[0], across[2]))))))


def overlap_mm(refined: Refined, pair: Sequence[Textured]) -> float:
    """Length along either sweep, the lesser, of which the other sees a good part of each image."""
    lengths = []
    for way, one in zip(refined.ways, pair, strict=True):
        many = np.bincount(one.plane, minlength=len(one.path.travel_mm))
        seen = np.bincount(one.plane[way.valid], minlength=len(one.path.travel_mm))
        at = one.path.travel_mm[(many > 0) & (seen >= 0.25 * np.maximum(many, 1))]
        lengths.append(float(np.ptp(at)) if at.size else 0.0)
    return min(lengths)


def bend_slice(which: int) -> slice:
    """Where the bends of a sweep are among the parameters."""
    return slice(RIGID + which * len(BENDS), RIGID + (which + 1) * len(BENDS))


def terms_of(path: Path, which: int) -> FloatArray:
    """Mean log scale, tilt and yaw per mm of one sweep by all parameters, shape (3, 20)."""
    terms = np.zeros((3, PARAMETERS))
    terms[0, bend_slice(which)] = path.mean_scale()
    terms[1, RIGID + which * len(BENDS) + 3] = 1.0
    terms[2, RIGID + which * len(BENDS) + 5] = 1.0
    return terms
