"""Tissue that moved between two crossing sweeps: how far, and what that does to the parameters.

A smooth displacement of the tissue is partly taken up by scale, turns and place; what is left of it shows as
a local displacement between the images of both sweeps. Restricted likelihood tells the two apart: of what is
left, a part is correlated over centimetres as the displacement of tissue is, and the rest is speckle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, eigh
from scipy.spatial.distance import cdist

from speckle3d.core.arrays import FloatArray
from speckle3d.correction.crossing.refine import Refined
from speckle3d.correction.crossing.similarity import PARAMETERS

PART_MM = 6.0
"""Side of the parts of tissue that are taken to move, or to err, as one."""

_REACH_MM = 12.0
"""Over which the correlation of the displacement falls to 1 / e: a probe's contact is centimetres wide, and
what it presses moves in one piece. 8 or 20 mm change what is said of lengths by a fifth."""
_SEEN = 1.5
"""What is there over what is found. Parts see shifts through images that are alike in part only, and the
smoothest of it passes for place and turn: of 0.3, 0.6 and 1.0 mm rms 0.21, 0.31 and 0.41 mm were found (six
simulated pairs each), 0.03 to 0.13 mm where nothing had moved."""
_LEFT = 0.3
"""Share of the median below which the fit left so little of a direction that its noise is all there is."""
_RATIOS = np.concatenate([[0.0], np.geomspace(0.01, 3.0, 60)])
"""Displacements tried, mm over the deviation of speckle's part: evenly likely beforehand."""


@dataclass(frozen=True)
class Parts:
    """What parts of the tissue say about the parameters and about a shift of their own.

    Attributes
    ----------
    middle_mm : ndarray, shape (n, 3)
        In the first path's frame.
    pulls : ndarray, shape (n, 20)
        Gradient of the cost with the parameters. The first three shift the second sweep against the first, so
        that they are a part's own shift, too.
    shared : ndarray, shape (n, 3, 20)
        Matrix of Gauss and Newton between that shift, mm, and all parameters.
    matrix : ndarray, shape (20, 20)
        The same between all parameters, of all parts.
    """

    middle_mm: FloatArray
    pulls: FloatArray
    shared: FloatArray
    matrix: FloatArray

    @classmethod
    def of(cls, refined: Refined) -> Parts:
        """Sum over the points of each part, both ways."""
        cells, values = [], []
        for way in refined.ways:
            residuals, rows = way.residuals(way.valid)
            points = way.points_mm[way.valid]
            cells.append(np.floor(points / PART_MM).astype(int))
            shared = (rows[:, :3, None] * rows[:, None, :]).reshape(len(rows), -1)
            weighed = refined.weight * np.concatenate([rows * residuals[:, None], shared], axis=1)
            values.append(np.concatenate([np.ones((len(rows), 1)), points, weighed], axis=1))
        number = np.unique(np.concatenate(cells), axis=0, return_inverse=True)[1].ravel()
        sums = np.zeros((int(number.max()) + 1, values[0].shape[1]))
        np.add.at(sums, number, np.concatenate(values))
        many, place, pulls, shared = np.split(sums, [1, 4, 4 + PARAMETERS], axis=1)
        return cls(place / many, pulls, shared.reshape(-1, 3, PARAMETERS), refined.matrix)


def rms_mm(parts: Parts) -> float:
    """RMS of each component of the displacement between the sweeps, at least zero.

    Parameters
    ----------
    parts : Parts
        Of a fit under a blur that is wide against the displacement: only then residuals are in proportion.
    """
    count = 3 * len(parts.pulls)
    shared = parts.shared.reshape(count, PARAMETERS)
    own = block_diag(*parts.shared[:, :, :3])
    matrix = parts.matrix + 1e-6 * np.diag(np.diag(parts.matrix))
    taken = np.linalg.solve(matrix, np.column_stack([shared.T, parts.pulls.sum(axis=0)]))
    left = own - shared @ taken[:, :-1]
    pulls = parts.pulls[:, :3].ravel() - shared @ taken[:, -1]
    # Whitened by what speckle does, which the parameters take up alike.
    values, vectors = eigh(left)
    kept = values > _LEFT * np.median(values)
    root = vectors[:, kept] * np.sqrt(values[kept])
    seen = (vectors[:, kept] / np.sqrt(values[kept])).T @ pulls
    power, axes = eigh(root.T @ _alike(parts) @ root)
    squares, power = (axes.T @ seen) ** 2, np.maximum(power, 0.0)
    # Restricted likelihood of the displacement in units of what speckle does, speckle at its best for each.
    whole = 1.0 + _RATIOS[:, None] ** 2 * power
    speckle = np.mean(squares / whole, axis=1)
    logs = -0.5 * (np.log(whole).sum(axis=1) + len(power) * np.log(speckle))
    share = np.exp(logs - logs.max()) * np.gradient(_RATIOS)
    return float(_SEEN * np.sqrt(share @ (_RATIOS**2 * speckle) / share.sum()))


def scatter(parts: Parts) -> FloatArray:
    """Covariance of the gradient of the cost with the parameters per mm^2 of displacement, shape (20, 20)."""
    shared = parts.shared.reshape(-1, PARAMETERS)
    return np.asarray(shared.T @ _alike(parts) @ shared)


def _alike(parts: Parts) -> FloatArray:
    """Correlation of the displacements of all parts and directions."""
    apart = cdist(parts.middle_mm, parts.middle_mm)
    return np.asarray(np.kron(np.exp(-apart / _REACH_MM), np.eye(3)), dtype=np.float64)
