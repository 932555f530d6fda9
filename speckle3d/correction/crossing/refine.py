"""Levenberg and Marquardt's steps, coarse to fine, on the correlation of both sweeps and on priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.correction.crossing.similarity import PARAMETERS, RIGID, OneWay, Placing, Textured, compared

_MOST_STEPS = 30
_SETTLED = 0.02
"""Step, in the posterior's own standard deviations, at which a level has converged."""
_LEAST_UNLIKE = 0.05
"""Least 1 - correlation by which residuals are weighed."""


@dataclass(frozen=True)
class Prior:
    """What is known of the parameters before looking.

    Attributes
    ----------
    information : ndarray, shape (14, 14)
        Inverse covariance of both sweeps' bends, about zero.
    turn : Rotation or None
        Of the second path against the first, by sensors.
    turn_information : ndarray, shape (3, 3)
        Of its error, in the first path's frame.
    """

    information: FloatArray
    turn: Rotation | None
    turn_information: FloatArray

    def pull(self, placing: Placing) -> tuple[FloatArray, FloatArray, float]:
        """Gradient and matrix of half the squared deviation, and its value."""
        gradient, matrix = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
        bends = placing.bends.ravel()
        gradient[RIGID:], matrix[RIGID:, RIGID:] = self.information @ bends, self.information
        value = 0.5 * float(bends @ self.information @ bends)
        if self.turn is not None:
            away = (placing.first_from_second.rotation * self.turn.inv()).as_rotvec()
            gradient[3:RIGID] = self.turn_information @ away
            matrix[3:RIGID, 3:RIGID] = self.turn_information
            value += 0.5 * float(away @ self.turn_information @ away)
        return gradient, matrix, value


@dataclass(frozen=True)
class Refined:
    """Where the steps ended.

    Attributes
    ----------
    ways : tuple of OneWay
        With derivatives.
    weight : float
        Half the squared residuals of both ways count so much.
    correlation : float
        Mean of both ways.
    matrix : ndarray, shape (20, 20)
        Of Gauss and Newton, images alone.
    independent : float
        How many comparisons the images are worth.
    strain : float
        Half the squared deviation from the priors.
    """

    placing: Placing
    ways: tuple[OneWay, OneWay]
    weight: float
    correlation: float
    matrix: FloatArray
    independent: float
    strain: float
    steps: int

    @property
    def log_likelihood(self) -> float:
        """Of the placing and its bends, up to what all placings of one pair share."""
        return float(-0.5 * self.independent * np.log(max(1.0 - self.correlation, 1e-3)) - self.strain)


def refined(
    pair: Sequence[Textured],
    start: Placing,
    prior: Prior,
    effective_samples: float,
    most_steps: int = _MOST_STEPS,
) -> Refined:
    """Refine a start at one blur."""
    placing, damping, steps = start, 1e-2, 0
    ways = compared(pair, placing)
    while True:
        correlation = np.mean([way.correlation(way.valid) for way in ways])
        # Both ways compare the same tissue, so that together they count once.
        weight = 0.5 * effective_samples / (2.0 * max(1.0 - float(correlation), _LEAST_UNLIKE))
        gradient, matrix = _system(ways, weight)
        pull, stiffness, strain = prior.pull(placing)
        if steps >= most_steps:
            break
        whole = matrix + stiffness
        moved = False
        while damping < 1e6:
            damped = whole + damping * np.diag(np.diag(whole))
            step = np.asarray(-np.linalg.solve(damped, gradient + pull), dtype=np.float64)
            trial = placing.stepped(step)
            tried = compared(pair, trial)
            if _cost(tried, ways, weight, prior.pull(trial)[2]) < _cost(ways, tried, weight, strain):
                moved = True
                break
            damping *= 8.0
        steps += 1
        if not moved:
            break
        placing, ways, damping = trial, tried, max(damping / 6.0, 1e-6)
        if float(step @ whole @ step) < _SETTLED**2 * PARAMETERS:
            steps = most_steps
    return Refined(placing, ways, weight, float(correlation), matrix, effective_samples, strain, steps)


def _system(ways: Sequence[OneWay], weight: float) -> tuple[FloatArray, FloatArray]:
    gradient, matrix = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
    for way in ways:
        if int(way.valid.sum()) < 2 * PARAMETERS:
            continue
        residuals, rows = way.residuals(way.valid)
        gradient += weight * (rows.T @ residuals)
        matrix += weight * (rows.T @ rows)
    return gradient, matrix


def _cost(ways: Sequence[OneWay], others: Sequence[OneWay], weight: float, strain: float) -> float:
    """Cost at the points that both of two placings show: else less overlap could pass for more likeness."""
    alike = [way.correlation(way.valid & other.valid) for way, other in zip(ways, others, strict=True)]
    return weight * sum(1.0 - each for each in alike) + strain
