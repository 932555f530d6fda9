"""The plane through a frame pair's patches: the second frame seen from the first.

z(x, y) = a + b (x - xc) + c (y - yc) for points of the second frame, about the image's centre, where
b = R31 and c = R32 of the relative rotation. The plane is fitted to the correlations themselves, whose errors
are nearly Gaussian, and not to distances, which are skewed where speckle has all but gone and missing
where it has. Correlations know no sign; the plane returned has a >= 0, and the trajectory settles its sign.

Tilt is nearly invisible to decorrelation: a focused beam's wavefront is curved about the focus, so that
turning moves the speckle of all depths alike, and patches see a + c (y - yc - pivot) with a pivot that grows
with depth as y does. The fit keeps what is seen; `speckle3d.motion.uncertainty` weighs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.threads import in_parallel
from speckle3d.kernels.plane_misfit import FitRules, Levers
from speckle3d.kernels.planes import FittedPlanes, fit_planes
from speckle3d.kernels.statistics import PatchCurves
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.distances import DistanceEstimator, EchoModel, PatchDistances

CROSSING_EVIDENCE = 6.0
"""Gain in twice the log-likelihood (a BIC) for which frames are taken to cross inside the image."""
OUTLYING = 9.0
"""Squared deviations at which a patch's misfit is capped. Where frames cross, correlation is known to a few
thousandths; one patch that lost it there would outvote all others."""
LOOSE_SLOPE = 0.05
"""Standard deviation of the slopes' prior, 3 degrees between frames that share speckle: keeps fits finite."""
SENSED_SLOPE = 5e-4
"""Standard deviation of slopes between near frames from a smoothed orientation sensor: 0.03 degrees."""
WELL_FITTED = 0.9
"""Squared deviations per patch below which no other hypothesis can do better by enough to matter."""
ROUNDS = 12
LEAST_PATCHES = 6
NEAR_MM = 0.15
"""Least distance at which fits start: correlation is flat at zero, and a fit from there takes distance for
tilt."""
PAIRS_AT_ONCE = 2048
"""Pairs that are fitted at once: what a fit needs of a long sweep's pairs is larger than its results."""
GRAIN = 32
"""Pairs that are worth another thread's while."""


class PlaneSettings(BaseModel):
    """How planes are fitted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    bias_mm: float = Field(
        0.02,
        ge=0,
        description="Error common to a pair's distances that no number of patches averages out; it keeps "
        "tiny separations from outweighing long ones.",
    )
    huber: float = Field(2.0, gt=0, description="Standard deviations at which a patch begins to lose weight.")
    support_sigma: float = Field(
        1.0, gt=0, description="Threshold of the orientation-consistent subset, standard deviations."
    )
    turn_deg_per_mm: float = Field(
        0.05,
        gt=0,
        description="Yaw and tilt per distance that sweeps are expected to have, standard deviation; what "
        "images see of them is believed as far as it is more certain than this.",
    )


@dataclass(frozen=True)
class PairPlanes:
    """Planes of frame pairs.

    Attributes
    ----------
    coefficients : ndarray, shape (e, 3)
        a, b and c.
    covariance : ndarray, shape (e, 3, 3)
        Of (a, b, c).
    used : ndarray of bool, shape (e, p)
        Patches that took part.
    excess_mm, sigma_mm : ndarray of float32, shape (e, p)
        How much farther each patch is than the plane has it, and the standard deviation of that, both to
        first order in the correlation; NaN for patches that took no part.
    determined : ndarray of bool, shape (e,)
        Pairs whose patches determine a plane; the others' mean nothing.
    """

    coefficients: FloatArray
    covariance: FloatArray
    used: BoolArray
    excess_mm: Float32Array
    sigma_mm: Float32Array
    determined: BoolArray

    def __len__(self) -> int:
        return len(self.coefficients)

    def __getitem__(self, pairs: IntArray | BoolArray | slice) -> PairPlanes:
        """Planes of some of the pairs."""
        return PairPlanes(*(getattr(self, each.name)[pairs] for each in fields(self)))

    @classmethod
    def none(cls, patches: int) -> PairPlanes:
        """Planes of no pair."""
        empty = np.zeros((0, patches), dtype=np.float32)
        return cls(
            np.zeros((0, 3)), np.zeros((0, 3, 3)), empty.astype(bool), empty, empty, np.zeros(0, dtype=bool)
        )

    @classmethod
    def concatenate(cls, planes: Sequence[PairPlanes]) -> PairPlanes:
        """Return the planes of several sets of pairs, one after the other."""
        return cls(*(np.concatenate([getattr(p, each.name) for p in planes]) for each in fields(cls)))

    def followed_by(self, others: PairPlanes) -> PairPlanes:
        """Return these planes and others."""
        return PairPlanes.concatenate([self, others])

    @property
    def offset_mm(self) -> FloatArray:
        """Offset a of each pair, shape (e,)."""
        return self.coefficients[:, 0]

    def scaled(self, factor: float) -> PairPlanes:
        """Return the same planes with all distances multiplied by a factor."""
        return replace(
            self,
            coefficients=self.coefficients * factor,
            covariance=self.covariance * factor**2,
            excess_mm=self.excess_mm * np.float32(factor),
            sigma_mm=self.sigma_mm * np.float32(factor),
        )

    def where(self, mask: BoolArray, others: PairPlanes) -> PairPlanes:
        """These planes where the mask of pairs says so, and those of `others` elsewhere."""
        chosen = []
        for each in fields(self):
            mine, theirs = getattr(self, each.name), getattr(others, each.name)
            chosen.append(np.where(mask.reshape(-1, *[1] * (mine.ndim - 1)), mine, theirs))
        return PairPlanes(*chosen)


class _Problem(NamedTuple):
    """Some pairs' correlations, the models they are read with, patches that take part, and starts."""

    correlation: Float32Array
    model: EchoModel
    used: BoolArray
    middle_mm: FloatArray


class PlaneFitter:
    """Fits planes to the correlations of a sweep's frame pairs."""

    def __init__(
        self, estimator: DistanceEstimator, at_mm: FloatArray, settings: PlaneSettings | None = None
    ) -> None:
        self.estimator = estimator
        self.settings = settings or PlaneSettings()
        self._curves = PatchCurves(estimator.amplitude, estimator.step_mm, estimator.cells, estimator.of_echo)
        zero = np.zeros(len(at_mm))
        tilt = estimator.tilt
        # Where the curves know nothing of tilt, it is taken to turn about the focus, and the focus to be at
        # the image's centre: all depths then see the centre's distance.
        self.levers = Levers(
            np.ascontiguousarray(at_mm[:, 0]),
            zero if tilt is None else at_mm[:, 1] - tilt.pivot_mm,
            zero if tilt is None else np.ascontiguousarray(tilt.spread_mm),
        )
        self._has_lever = tilt is not None

    def distances(
        self, correlation: Float32Array, coherence: Coherence | None, frame: IntArray
    ) -> PatchDistances:
        """Distances of the patches of some pairs, whose coherence is taken at a frame each."""
        model = None if coherence is None else coherence.models(frame)
        return self.estimator.distances(correlation.astype(float), model)

    def design(self) -> FloatArray:
        """What a, b and c are multiplied by for each patch, without in-plane motion, shape (p, 3)."""
        lateral, lever, _ = self.levers
        return np.column_stack([np.ones(len(lateral)), lateral, lever])

    def raised(self, moved_mm: FloatArray, slopes: FloatArray) -> FloatArray:
        """How much farther patches are than the image's centre on planes of some slopes, shape (e, p).

        Parameters
        ----------
        moved_mm : ndarray, shape (e, 2)
            In-plane displacement of the second frame.
        slopes : ndarray, shape (e, 2)
            b and c.
        """
        lost = (slopes * self._lost(moved_mm)).sum(axis=1, keepdims=True)
        return np.asarray(slopes @ self.design()[:, 1:].T - lost)

    def _lost(self, moved_mm: FloatArray) -> FloatArray:
        """What in-plane motion takes from the patches' lateral positions and levers, shape (e, 2)."""
        return np.ascontiguousarray(moved_mm * np.array([1.0, float(self._has_lever)]))

    def fit(
        self,
        correlation: Float32Array,
        moved_mm: FloatArray,
        coherence: Coherence | None = None,
        frame: IntArray | None = None,
        subset: BoolArray | None = None,
        slopes: FloatArray | None = None,
        start_mm: FloatArray | None = None,
        either_side: BoolArray | None = None,
    ) -> PairPlanes:
        """Robust maximum likelihood, pair by pair.

        A pair determines no plane if fewer than six patches can take part, or if the image's centre comes to
        lie farther away than the curves were measured, or might.

        Parameters
        ----------
        correlation : ndarray of float32, shape (e, p)
        moved_mm : ndarray, shape (e, 2)
            In-plane displacement of the second frame.
        coherence : Coherence, optional
            With which the correlations are read; a phantom's, if not given.
        frame : ndarray of int, shape (e,), optional
            At which the coherence of each pair is taken.
        subset : ndarray of bool, shape (e, p), optional
            Patches allowed to take part.
        slopes : ndarray, shape (e, 2), optional
            b and c as a sensor has them. The planes' signs are then theirs, and a may be negative.
        start_mm : ndarray, shape (e,), optional
            About how far apart the frames are, if it is known.
        either_side : ndarray of bool, shape (e,), optional
            Whether a plane of known slopes may have a < 0; all may, if not given.
        """
        pairs = len(correlation)
        told = np.zeros((pairs, 2)) if slopes is None else np.ascontiguousarray(slopes)
        side = np.ones(pairs, dtype=bool) if either_side is None else either_side
        rules, fitted = self._rules(slopes is not None), []
        for first in range(0, max(pairs, 1), PAIRS_AT_ONCE):
            some = slice(first, first + PAIRS_AT_ONCE)
            problem = self._problem(
                correlation[some],
                None if coherence is None or frame is None else coherence.models(frame[some]),
                None if subset is None else subset[some],
                None if start_mm is None else start_mm[some],
            )
            fitted.append(self._fit_some(problem, self._lost(moved_mm[some]), told[some], side[some], rules))
        return PairPlanes.concatenate(fitted)

    def _problem(
        self,
        correlation: Float32Array,
        model: EchoModel | None,
        subset: BoolArray | None,
        start_mm: FloatArray | None,
    ) -> _Problem:
        """Which patches take part, and about how far apart frames are."""
        model = model or EchoModel.fully_developed(correlation.shape[1])
        used = np.isfinite(correlation) & self._measured(correlation, model)
        used = used if subset is None else used & subset
        used &= (used.sum(axis=1) >= LEAST_PATCHES)[:, None]
        middle = self._middle(correlation, used, model) if start_mm is None else np.maximum(start_mm, NEAR_MM)
        return _Problem(correlation, model, used, middle)

    def _fit_some(
        self, problem: _Problem, lost: FloatArray, told: FloatArray, side: BoolArray, rules: FitRules
    ) -> PairPlanes:
        pairs, patches = problem.correlation.shape
        fitted = FittedPlanes(
            np.full((pairs, 3), np.nan),
            np.tile(np.eye(3), (pairs, 1, 1)),
            np.zeros(pairs),
            np.full((pairs, patches), np.nan),
            np.full((pairs, patches), np.nan),
        )

        def work(first: int, stop: int) -> None:
            some = slice(first, stop)
            fit_planes(
                problem.correlation[some],
                problem.used[some],
                lost[some],
                problem.model[some].for_kernels(),
                self.levers,
                self._curves,
                problem.middle_mm[some],
                told[some],
                side[some],
                rules,
                FittedPlanes(*(array[some] for array in fitted)),
            )

        in_parallel(work, pairs, GRAIN)
        return self._concluded(fitted, problem.used, turned=not rules.sensed)

    def _rules(self, sensed: bool) -> FitRules:
        return FitRules(
            sensed,
            SENSED_SLOPE if sensed else LOOSE_SLOPE,
            LOOSE_SLOPE,
            self.settings.huber,
            OUTLYING,
            CROSSING_EVIDENCE,
            WELL_FITTED,
            ROUNDS,
        )

    def _concluded(self, fitted: FittedPlanes, used: BoolArray, turned: bool) -> PairPlanes:
        """Planes with their covariances; those with a < 0 turned over if `turned`."""
        coefficients, information, cost, *residuals = fitted
        patches = used.sum(axis=1)
        scatter = np.maximum(1.0, cost / np.maximum(patches - 3, 1))
        covariance = np.linalg.inv(information) * scatter[:, None, None]
        covariance[:, 0, 0] += self.settings.bias_mm**2
        # Where next to nothing of the echo is left, any distance fits as well: tens of metres have been seen.
        reach = self.estimator.reach_mm
        determined = (np.abs(coefficients[:, 0]) <= reach) & (covariance[:, 0, 0] <= reach**2)
        if turned:
            coefficients *= np.where(coefficients[:, :1] < 0, -1.0, 1.0)
        excess, sigma = (each.astype(np.float32) for each in residuals)
        return PairPlanes(coefficients, covariance, used, excess, sigma, determined)

    def _measured(self, correlation: Float32Array, model: EchoModel) -> BoolArray:
        """Patches that correlate more than at their curve's last distance."""
        end = self.estimator.end_amplitude
        if not end.any():
            return np.ones(correlation.shape, dtype=bool)
        least = model.gain * (model.share + (1 - model.share) * end) ** 2
        return np.asarray((end == 0.0) | (correlation > least))

    def _middle(self, correlation: Float32Array, used: BoolArray, model: EchoModel) -> FloatArray:
        """About how far apart frames are, by the median of their patches' correlations, shape (e,)."""
        known = np.sort(np.where(used, correlation, np.inf), axis=1)
        count = np.maximum(used.sum(axis=1), 1)
        pair = np.arange(len(known))
        median = (known[pair, (count - 1) // 2].astype(float) + known[pair, count // 2]) / 2
        share = model.share.mean(axis=1)
        left = (np.sqrt(np.maximum(np.where(np.isfinite(median), median, 0.0), 0.0)) - share) / np.maximum(
            1.0 - share, 0.1
        )
        return self.estimator.typical_distance(left)
