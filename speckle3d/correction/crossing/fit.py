"""Registration of two crossing sweeps by Levenberg-Marquardt, with its covariance.

Tissue that moved between the sweeps is partly taken up by scale, turns and place; what is left of it pulls
neighbouring parts of the tissue alike, where speckle pulls each by itself. These two moments tell both.

References
----------
.. [1] P. J. Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", Proc. Fifth
   Berkeley Symp. Math. Stat. Prob. 1, 1967 (the covariance).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.correction.crossing.planes import BENDS
from speckle3d.correction.crossing.similarity import (
    PARAMETERS,
    RIGID,
    BlurredSweep,
    OneWay,
    Placing,
    look_up_points,
)
from speckle3d.correction.crossing.stack import PIXEL_MM

_MOST_STEPS = 30
_LEAST_STEP = 0.02
"""Step, in the posterior's own standard deviations, at which a level has converged."""
PART_MM = 6.0
"""Side of the parts of tissue that are taken to move, or to err, as one. Half of it makes claims of two
simulated pairs 1.4 times as large, twice as much 0.9; lengths stay."""
_REACH_MM = 12.0
"""Over which the correlation of tissue's displacement falls to 1 / e: a probe's contact is centimetres wide,
and what it presses moves in one piece. Half and twice as much move claims by 5 %."""
_DISPLACEMENT_RATIO = 1.5
"""True displacements over what parts show of them: parts see shifts through images that are alike in part
only, and the smoothest of it passes for place and turn. Of simulated pairs; at 1 claims are 6 % smaller."""
_USUAL_MM = 0.3
"""Displacement, mm over the deviation of speckle's part, for which it is found best. At 0, without weights,
claims of six simulated pairs are up to 15 % smaller; lengths stay."""
FACES = 0.006
"""Relative standard deviation of the scale by what is not understood: lengths of simulated pairs with exact
poses came out 0.6 % long, cause unknown. Sweeps of simulated radio-frequency data do not show it."""
SCALES = [RIGID, RIGID + BENDS]
"""Where the mean scales of both sweeps are among the parameters."""


@dataclass(frozen=True)
class PathPrior:
    """Gaussian prior of the parameters.

    Attributes
    ----------
    information : ndarray, shape (30, 30)
        Inverse covariance of the parameters; zero where nothing is known.
    turn : Rotation or None
        Of the second path against the first, by sensors.
    """

    information: FloatArray
    turn: Rotation | None = None

    def deviation(self, placing: Placing) -> FloatArray:
        """Parameters less what is expected, shape (30,)."""
        away = np.concatenate([np.zeros(RIGID), placing.bends.ravel()])
        if self.turn is not None:
            away[3:RIGID] = (placing.first_from_second.rotation * self.turn.inv()).as_rotvec()
        return away


@dataclass(frozen=True)
class CrossingFit:
    """Two sweeps at a placing under one blur.

    Attributes
    ----------
    independent : float
        How many comparisons the images are worth.
    """

    pair: Sequence[BlurredSweep]
    placing: Placing
    prior: PathPrior
    independent: float

    @cached_property
    def ways(self) -> tuple[OneWay, OneWay]:
        """Points of either sweep looked up in the other."""
        return look_up_points(self.pair, self.placing)

    @cached_property
    def correlation(self) -> float:
        """Mean of both ways; below one even of a sweep and itself."""
        return min(float(np.mean([way.correlation(way.valid) for way in self.ways])), 0.999)

    @property
    def strain(self) -> float:
        """Half the squared deviation from the prior."""
        away = self.prior.deviation(self.placing)
        return 0.5 * float(away @ self.prior.information @ away)

    @property
    def weight(self) -> float:
        """Half the squared residuals of both ways, which compare the same tissue, count so much."""
        return 0.25 * self.independent / (1.0 - self.correlation)

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the placing and its bends, up to a constant of the pair."""
        return -0.5 * self.independent * float(np.log1p(-self.correlation)) - self.strain

    @cached_property
    def normal_equations(self) -> tuple[FloatArray, FloatArray]:
        """Matrix of Gauss and Newton with the prior's, shape (30, 30), and gradient of the cost."""
        information = self.prior.information
        gradient, hessian = information @ self.prior.deviation(self.placing), np.zeros_like(information)
        for way in self.ways:
            residuals, rows = way.residuals()
            gradient, hessian = gradient + self.weight * (rows.T @ residuals), hessian + rows.T @ rows
        return information + self.weight * hessian, gradient

    def is_better(self, fit: CrossingFit) -> bool:
        """Whether the cost is below another's at the points that both show, by the other's weight."""
        gain = fit.strain - self.strain
        for way, reference in zip(self.ways, fit.ways, strict=True):
            common = way.valid & reference.valid
            # Less overlap could pass for more likeness.
            if common.sum() < 0.5 * reference.valid.sum():
                return False
            gain += fit.weight * (way.correlation(common) - reference.correlation(common))
        return gain > 0.0

    def refine(self) -> CrossingFit:
        """At the placing of least cost nearby."""
        fit, damping = self, 1e-2
        for _ in range(_MOST_STEPS):
            matrix, gradient = fit.normal_equations
            step = np.asarray(-np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), gradient))
            trial = replace(fit, placing=fit.placing.moved_by(step))
            if not trial.is_better(fit):
                damping *= 8.0
                continue
            close = step @ matrix @ step < _LEAST_STEP**2 * PARAMETERS
            fit, damping = trial, max(damping / 6.0, 1e-6)
            if close:
                break
        return fit

    @property
    def angle_deg(self) -> float:
        """Angle between the directions in which both sweeps' images run across, 0 to 90 degrees."""
        across = self.placing.first_from_second.rotation.as_matrix()[:, 0]
        return float(np.rad2deg(np.arccos(min(1.0, abs(float(across[0] / np.hypot(across[0], across[2])))))))

    @property
    def overlap_mm(self) -> float:
        """Length along either sweep, the lesser, of which the other sees a good part of each image."""
        lengths = []
        for way, sweep in zip(self.ways, self.pair, strict=True):
            every, visible = (
                np.bincount(plane, minlength=len(sweep.volume))
                for plane in (sweep.plane, sweep.plane[way.valid])
            )
            at = np.flatnonzero((every > 0) & (visible >= 0.25 * every))
            lengths.append(PIXEL_MM * float(np.ptp(at)) if at.size else 0.0)
        return min(lengths)


@dataclass(frozen=True)
class CubeSums:
    """Gradient and curvature of the cost, summed over cubes of tissue.

    Attributes
    ----------
    pulls : ndarray, shape (n, 30)
        Gradient of the cost with the parameters. The first three shift the second sweep against the first, so
        that they are a part's own shift, too.
    coupling : ndarray, shape (n, 3, 30)
        Matrix of Gauss and Newton between that shift, mm, and all parameters.
    correlation : ndarray, shape (3 n, 3 n)
        Correlation of the displacements of all parts and directions.
    """

    pulls: FloatArray
    coupling: FloatArray
    correlation: FloatArray

    @classmethod
    def of(cls, fit: CrossingFit) -> CubeSums:
        """Sum over the points of each part, both ways."""
        points, values = [], []
        for way in fit.ways:
            residuals, rows = way.residuals()
            points.append(way.points_mm[way.valid])
            coupling = (rows[:, :3, None] * rows[:, None, :]).reshape(len(rows), -1)
            values.append(fit.weight * np.concatenate([rows * residuals[:, None], coupling], axis=1))
        places, rows = np.concatenate(points), np.concatenate(values)
        cells, number = np.unique(np.floor(places / PART_MM), axis=0, return_inverse=True)
        sums = np.zeros((len(cells), rows.shape[1]))
        np.add.at(sums, number.ravel(), rows)
        correlation = np.kron(np.exp(-PART_MM * cdist(cells, cells) / _REACH_MM), np.eye(3))
        pulls, products = np.split(sums, [PARAMETERS], axis=1)
        return cls(pulls, products.reshape(-1, 3, PARAMETERS), np.asarray(correlation, dtype=np.float64))

    def displacement_mm(self, matrix: FloatArray) -> float:
        """RMS of each component of the tissue's displacement between the sweeps, at least zero.

        Parameters
        ----------
        matrix : ndarray, shape (30, 30)
            Of Gauss and Newton and of the prior, of a fit under a blur that is wide against the displacement:
            only then residuals are in proportion.
        """
        coupling = self.coupling.reshape(-1, PARAMETERS)
        response = np.linalg.solve(matrix, coupling.T)
        stiffness = block_diag(*self.coupling[:, :, :3]) - coupling @ response
        pulls = self.pulls[:, :3].ravel() - self.pulls.sum(axis=0) @ response
        values, vectors = np.linalg.eigh(stiffness)
        # Of what the fit left nearly nothing, noise is all there is.
        informative = values > 0.3 * np.median(values)
        root = vectors[:, informative] * np.sqrt(values[informative])
        white = (root / values[informative]).T @ pulls
        # Squares grow with the power that a displacement would have: by its variance, beyond speckle's.
        power, axes = np.linalg.eigh(root.T @ self.correlation @ root)
        weight = 1.0 / (1.0 + _USUAL_MM**2 * power)
        slope = np.polyfit(power, (axes.T @ white) ** 2, 1, w=weight)[0]
        return _DISPLACEMENT_RATIO * float(np.sqrt(max(slope, 0.0)))


def covariance(fit: CrossingFit, displacement_mm: float) -> FloatArray:
    """Covariance of all parameters, shape (30, 30).

    The images' curvature says how the answer moves with the residuals; what the parts of the tissue pull by
    says how much residuals vary if they err independently, and what tissue that moved as one does to the
    answer comes on top.

    Parameters
    ----------
    displacement_mm : float
        RMS of each component of the tissue's displacement between the sweeps.
    """
    parts = CubeSums.of(fit)
    coupling, count = parts.coupling.reshape(-1, PARAMETERS), len(parts.pulls)
    scatter = parts.pulls.T @ parts.pulls * count / max(count - 1, 1)
    scatter += displacement_mm**2 * coupling.T @ parts.correlation @ coupling
    inverse = np.linalg.inv(fit.normal_equations[0])
    whole = inverse @ (scatter + fit.prior.information) @ inverse
    whole[SCALES, SCALES] += FACES**2
    return np.asarray(whole)
