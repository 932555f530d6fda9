"""Consensus on the candidates that show one common point, judged a contrario.

A frame may offer several candidates, all of them wrong. Four candidates from four frames give a calibration
by linear equations; the one with which most frames agree is kept if so much agreement is not to be expected
by chance: of candidates exchanged between the frames, whose poses then tell nothing about them.

References
----------
.. [1] M. A. Fischler and R. C. Bolles, "Random sample consensus", Commun. ACM, 1981.
.. [2] P. Moulon, P. Monasse and R. Marlet, "Adaptive structure from motion with a contrario model
   estimation", ACCV, 2012 (the number of false alarms; there chance is uniform over the image).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import binom

from calibration.motion import DOUBTS
from calibration.points import ImagePoints, affine_equations
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError

GATES_MM = (1.0, 1.5, 2.5, 4.0)
"""How near the crossing a candidate must come to agree. Points picked by hand leave 1 mm RMS, the worst of
them 3; beyond 4 mm a calibration with one point would not be of use."""

FALSE_ALARMS = 1e-3
"""Agreements as good, expected among chance candidates, below which a consensus is believed: one recording in
a thousand of nothing is calibrated with."""

_SAMPLE = 4
"""Frames that give twelve equations, for the image's origin, its two axes and the point."""
_MOST_FRAMES = 120
"""Frames that vote; more would vote alike."""
_BATCHES = (300, *[3000] * 10)
"""Samples drawn at a time. With the right candidate drawn in three frames of ten, one sample in 120 is right;
in one of ten, one in 10,000. All take some two seconds."""
_BEST_SAMPLES = 25
"""Best samples of a batch that are refined and judged."""
_SURE = -0.5
"""Logarithm of the false alarms, over the number of frames, at which the search ends: a third of the frames
agree to within a hundredth of the image, or more to less."""
_LOOSE_MM = 6.0
"""Samples of four are as uncertain as this where frames are turned by some ten degrees."""
_TIGHTER_MM = (6.0, 5.0, 4.0, 3.0, 3.0)
_PLAUSIBLE_PIXEL = 2.0
"""Greatest ratio of a pixel size to the one given, either way; those of samples are uncertain."""
_SQUARE = 0.6
"""Greatest cosine between the axes of a sample; 90 degrees minus 37."""
_FAR_MM = 300.0
"""What origin and point may be from the sensor and the middle of its path; holds what motion leaves open."""


@dataclass(frozen=True)
class Consensus:
    """One candidate of each frame, and those that agree.

    Attributes
    ----------
    choice : ndarray of int, shape (f,)
        For each frame, ascending, the candidate chosen, as a row of the points: see `choose_by_frame`.
    away_mm : ndarray, shape (f,)
        How far it is from where the point should be.
    gate_mm : float
    false_alarms : float
        Number of calibrations with as much agreement expected among chance candidates.
    """

    choice: IntArray
    away_mm: FloatArray
    gate_mm: float
    false_alarms: float

    @property
    def inliers(self) -> BoolArray:
        """Frames whose candidate is within `gate_mm`, shape (f,)."""
        return self.away_mm <= self.gate_mm

    @property
    def is_significant(self) -> bool:
        """Whether agreement by chance is unlikely."""
        return self.false_alarms <= FALSE_ALARMS

    def require(self) -> Consensus:
        """Raise `InsufficientDataError` unless it is significant."""
        if not self.is_significant:
            raise InsufficientDataError(
                f"expected one point that the frames agree on beyond chance, got {self.inliers.sum()} "
                f"of {len(self.inliers)} frames within {self.gate_mm:g} mm, which chance gives "
                f"{self.false_alarms:.2g} times a recording (limit {FALSE_ALARMS:g}): {DOUBTS} "
                "Points picked by hand, or a region to look in, would help"
            )
        return self


def find_consensus(points: ImagePoints, pixel_mm: FloatArray) -> Consensus:
    """Find the calibration with which most frames have a candidate where the point should be.

    Parameters
    ----------
    points : ImagePoints
        Candidates; those of a frame have its number and one pose, the likeliest first.
    pixel_mm : ndarray, shape (2,)
        Column pitch and row spacing, to a factor of two.

    Returns
    -------
    Consensus
        The one with the fewest false alarms; the caller judges them (`Consensus.require`).
    """
    rng, best = np.random.default_rng(0), (np.inf, GATES_MM[-1], np.zeros(12))
    voters = _Candidates(points.of_some_frames(_MOST_FRAMES), pixel_mm)
    for count in _BATCHES:
        for model in voters.best(voters.samples(rng, count)):
            refit = voters.refine(model)
            best = min(best, (*voters.false_alarms(refit), refit), key=lambda fit: fit[0])
        if best[0] < _SURE * len(voters.frames):
            break
    log_alarms, gate, model = best
    axes = model[3:9].reshape(2, 3) / voters.spread
    place = model[:3] + (points.pixels - voters.centre) @ axes
    away = np.linalg.norm(points.world_from_sensor.apply(place) - voters.middle - model[9:], axis=1)
    choice = choose_by_frame(points.frame, away)
    return Consensus(choice, away[choice], gate, float(10.0 ** min(log_alarms, 300.0)))


def choose_by_frame(frame: IntArray, away_mm: FloatArray, near_mm: float = GATES_MM[-2]) -> IntArray:
    """Choose the likeliest candidate of each frame that is near, or else the nearest; frames ascending.

    Along a wire that lies in the image there are several near ones. The nearest of them would repeat what the
    other frames say, with the errors of that: pixels came out 1 % too narrow, and claims too small.
    """
    order = np.lexsort((np.maximum(away_mm, near_mm), frame))
    return order[np.unique(frame[order], return_index=True)[1]]


class _Candidates:
    """Candidates as equations linear in the image's origin, its axes and the point: twelve unknowns.

    Pixels and positions are centred, and pixels scaled, so that all unknowns are millimetres.
    """

    def __init__(self, points: ImagePoints, pixel_mm: FloatArray) -> None:
        self.points = points
        self.frames, self.of_frame, self.count = np.unique(
            points.frame, return_inverse=True, return_counts=True
        )
        self.start = np.cumsum(self.count) - self.count
        self.centre, self.spread = points.pixels.mean(axis=0), float(points.pixels.std()) or 1.0
        self.middle = points.shifts_mm.mean(axis=0)
        self.places = (points.pixels - self.centre) / self.spread
        minus = np.broadcast_to(-np.eye(3), (len(points), 3, 3))
        self.rows = np.concatenate([affine_equations(self.places, points.turns), minus], axis=2)
        self.target = self.middle - points.shifts_mm
        sizes = np.outer([1.0 / _PLAUSIBLE_PIXEL, _PLAUSIBLE_PIXEL], pixel_mm)
        self.shortest, self.longest = sizes * self.spread
        widths = [np.full(3, _FAR_MM), np.repeat(self.longest, 3), np.full(3, _FAR_MM)]
        self.prior = np.diag(np.concatenate(widths) ** -2.0)

    def samples(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Models of candidates drawn from four frames each, the likelier more often, shape (count, 12)."""
        frames = np.argsort(rng.random((count, len(self.frames))), axis=1)[:, :_SAMPLE]
        # Uniform in the rank's logarithm.
        rank = (self.count[frames] + 1.0) ** rng.random(frames.shape) - 1.0
        sample = self.start[frames] + rank.astype(int)
        return self._solve(self.rows[sample].reshape(count, -1, 12), self.target[sample].reshape(count, -1))

    def _solve(self, matrix: FloatArray, target: FloatArray) -> FloatArray:
        transpose = np.swapaxes(matrix, -1, -2)
        normal = transpose @ matrix + self.prior
        return np.asarray(np.linalg.solve(normal, transpose @ target[..., None])[..., 0])

    def best(self, models: FloatArray) -> FloatArray:
        """The plausible models with the least sum of the frames' squared distances, each bounded."""
        axes = models[:, 3:9].reshape(-1, 2, 3)
        length = np.linalg.norm(axes, axis=2)
        cosine = np.abs(np.sum(axes[:, 0] * axes[:, 1], axis=1)) / np.prod(np.maximum(length, 1e-9), axis=1)
        plausible = np.all((length > self.shortest) & (length < self.longest), axis=1)
        models = models[plausible & (cosine < _SQUARE)]
        cost = np.minimum(self._nearest(models), _LOOSE_MM**2).sum(axis=1)
        return models[np.argsort(cost, kind="stable")[:_BEST_SAMPLES]]

    def _nearest(self, models: FloatArray) -> FloatArray:
        """Squared distance of each frame's nearest candidate from the point, shape (models, frames)."""
        rows = self.rows.reshape(-1, 12).astype(np.float32)
        residuals = models.astype(np.float32) @ rows.T - self.target.ravel().astype(np.float32)
        squares = np.sum(residuals.reshape(len(models), len(self.of_frame), 3) ** 2, axis=2)
        return np.minimum.reduceat(squares, self.start, axis=1)

    def refine(self, model: FloatArray) -> FloatArray:
        """The model of the candidates that agree with it, within less and less."""
        for gate in _TIGHTER_MM:
            squares = np.sum((self.rows @ model - self.target) ** 2, axis=1)
            first = choose_by_frame(self.of_frame, squares, 0.0)
            agreeing = first[squares[first] < gate**2]
            if len(agreeing) <= _SAMPLE:
                break
            model = self._solve(self.rows[agreeing].reshape(-1, 12), self.target[agreeing].ravel())
        return model

    def false_alarms(self, model: FloatArray) -> tuple[float, float]:
        """Logarithm of the number of false alarms at the gate where it is least, and that gate, mm.

        (n - 4) C(n, k) C(k, 4) m^4 p^(k - 4): sizes of the agreeing set, sets, samples in a set with m
        candidates in each frame, and the chance that the rest of the set agrees (reference 2, equation 2).
        """
        n, per_frame = len(self.frames), float(self.count.mean())
        if n <= _SAMPLE:
            return np.inf, GATES_MM[-1]
        away, axes = np.sqrt(self._nearest(model[None])[0]), model[3:9].reshape(2, 3)
        # The nearest candidate of each other frame, had it each frame's pose.
        place, turns = model[:3] + self.places @ axes, self.points.turns[self.start]
        offset = np.einsum("fij,nj->fni", turns, place) - self.target[self.start][:, None] - model[9:]
        by_chance = np.minimum.reduceat(np.linalg.norm(offset, axis=2), self.start, axis=1)
        by_chance = by_chance[~np.eye(n, dtype=bool)]
        area = float(np.prod(np.maximum(np.ptp(self.places, axis=0), 0.1) * np.linalg.norm(axes, axis=1)))
        logarithms = []
        for gate in GATES_MM:
            # Few frames have few pairs to count: at least what candidates all over the image would give.
            least = np.pi * gate**2 * per_frame / max(area, np.pi * gate**2)
            chance = min(max(float(np.mean(by_chance < gate)), least), 1.0)
            agreeing = max(int(np.sum(away < gate)), _SAMPLE)
            sets = (n - _SAMPLE) * binom(n, agreeing) * binom(agreeing, _SAMPLE)
            tail = (agreeing - _SAMPLE) * np.log10(chance)
            logarithms.append(np.log10(sets * per_frame**_SAMPLE) + tail)
        best = int(np.argmin(logarithms))
        return logarithms[best] + np.log10(len(GATES_MM)), GATES_MM[best]
