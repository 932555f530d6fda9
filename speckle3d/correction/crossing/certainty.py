"""How far the answer may be off, by how parts of the tissue disagree, and whether it may be believed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.correction.crossing.moved import Parts, scatter
from speckle3d.correction.crossing.path import BENDS, Path
from speckle3d.correction.crossing.refine import Prior, Refined
from speckle3d.correction.crossing.similarity import PARAMETERS, RIGID, Textured

FACES = 0.006
"""Relative standard deviation of the scale by what is not understood: lengths of simulated pairs with exact
poses came out 0.6 % long, cause unknown. Sweeps of simulated radio-frequency data do not show it."""

OBLIQUE = 0.022
"""The same of sweeps that cross obliquely, times the cosine of their angle: of four pairs of simulated
radio-frequency sweeps at 45 degrees lengths came out 0.5 to 3.6 % short, 2.7 rms and cause unknown."""


def covariance(refined: Refined, prior: Prior, moved_mm: float) -> FloatArray:
    """Covariance of all parameters, shape (20, 20).

    The images' curvature says how the answer moves with the residuals; what the parts of the tissue pull by
    says how much residuals vary if they err independently, and what tissue that moved as one does to the
    answer comes on top. Of 40 lengths of simulated pairs (seeds below 1000: still, moved by 0.3 to 0.6 mm,
    odd motion, poor texture) 68 and 95 % lay within one and two deviations.

    Parameters
    ----------
    moved_mm : float
        RMS of each component of the tissue's displacement between the sweeps.
    """
    _, stiffness, _ = prior.pull(refined.placing)
    inverse = np.linalg.inv(refined.matrix + stiffness)
    parts = Parts.of(refined)
    many = len(parts.pulls)
    pulled = parts.pulls.T @ parts.pulls * many / max(many - 1, 1)
    pulled += moved_mm**2 * scatter(parts)
    found = inverse @ (pulled + stiffness) @ inverse
    scales = [bend_slice(which).start for which in (0, 1)]
    found[scales, scales] += FACES**2 + (OBLIQUE * np.cos(np.deg2rad(angle_deg(refined)))) ** 2
    return np.asarray(found)


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
