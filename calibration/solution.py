"""Solve a calibration from a start: outlying frames, covariance, alternative answers."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr, stdtrit

from calibration.motion import DOUBTS, Adequacy, judge
from calibration.noise import fit_noise
from calibration.points import CHAIN, POSE, PROBE, SOME_FRAMES, ImagePoints, columns_of, in_chain
from calibration.settings import OUTLIER_SIGMA, PixelSettings
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import skew
from speckle3d.core.leastsquares import condition_number, robust_sigma
from speckle3d.core.text import shown

if TYPE_CHECKING:
    from calibration.plane import Chain, Phantom

_SMALLEST_SIGMA = 1e-7
"""Residuals of exact data are rounding; nothing in them is an outlier."""
_ROUNDS = 12
"""Most rounds of leaving out frames: they may come and go without an end."""
_FEWEST_FRAMES, _FEWEST_EQUATIONS = 6, 2.5
"""Frames, and equations to an unknown. With fewer, most scans are refused, and those whose noise seems small
by chance are not: of planes in ten frames 62 % of errors lay within the 95 % intervals of those accepted."""
_SIZE_CHANGE = 0.1
"""A fit with wandering errors that changes pixel sizes by a tenth has run away along what the motion leaves
open."""
_CONTRADICTS = 3.0
"""Standard errors by which points must move what was known for it to be doubted."""
_STATED = 0.5, np.deg2rad(1.0)
"""Standard errors of a phantom's stated place: of styluses, half a millimetre, and a degree over 50 mm."""
_CUT = 3.0
"""Residuals count up to so many standard deviations where answers are compared."""
_APART = 0.06
"""Share of the image's size by which two answers differ somewhere: turned by 3.5 degrees about a corner."""


@dataclass(frozen=True)
class Prior:
    """Prior of the pixel size and of the phantom's place.

    Attributes
    ----------
    pixel_mm : ndarray, shape (2,)
    world_from_target : ndarray, shape (4, 4)
    sigma : ndarray, shape (14,)
        Standard errors of both, as displacements in the order of `CHAIN`; infinite where nothing is known.
    """

    pixel_mm: FloatArray
    world_from_target: FloatArray
    sigma: FloatArray

    @classmethod
    def of(cls, pixel_mm: FloatArray | None = None, pixel_error: float = np.inf) -> Prior:
        """Prior of a pixel size, if known, with its relative error."""
        size, sigma = np.ones(2), np.full(len(CHAIN), np.inf)
        if pixel_mm is not None:
            size, sigma[:2] = pixel_mm, pixel_error * pixel_mm
        return cls(size, np.eye(4), sigma)

    def with_place(self, world_from_target: FloatArray) -> Prior:
        """The prior with a phantom's stated place."""
        sigma = np.append(self.sigma[:8], np.repeat(_STATED, 3))
        return replace(self, world_from_target=world_from_target, sigma=sigma)

    @property
    def known_pixel_mm(self) -> FloatArray | None:
        """Prior pixel size, if any."""
        return self.pixel_mm if np.isfinite(self.sigma[0]) else None

    def displacement(self, chain: Chain) -> FloatArray:
        """Displacement of a chain from the prior, in the order of `CHAIN`, shape (14,)."""
        away, offset = np.zeros(len(CHAIN)), chain.target @ self.world_from_target
        away[:2], away[8:11] = chain.pixel_mm - self.pixel_mm, offset[:3, 3]
        away[11:] = 0.5 * (offset - offset.T)[[1, 0, 2], [0, 2, 1]]
        return away

    def deviation(self, chain: Chain) -> FloatArray:
        """Displacement from the prior in standard errors; zero without a prior."""
        return self.displacement(chain) / self.sigma


UNKNOWN = Prior.of()


@shown
@dataclass(frozen=True)
class Solution:
    """Solution of a calibration: chain, covariance, and the frames used.

    Attributes
    ----------
    free : tuple of str, length p
        The parameters estimated, among `CHAIN`.
    covariance : ndarray, shape (p, p)
        Of the free parameters: small displacements in the image's frame and in the phantom's.
    points : ImagePoints
        All that were given.
    used : ndarray of bool, shape (n,)
    residuals : ndarray, shape (n, r)
        Of all points, mm (sines of angles for directions).
    sigma : float
        Robust standard deviation of the residuals of the points used.
    evidence : float
        By how much the sum of squared residuals of another answer, far away, to which a discrete ambiguity
        leads, exceeds the solution's, in variances of an independent one.
    assumed : str
        What no image tells, and was taken for granted; how much of what was stated is believed.
    """

    chain: Chain
    phantom: Phantom
    free: tuple[str, ...]
    covariance: FloatArray
    points: ImagePoints
    used: BoolArray
    residuals: FloatArray
    sigma: float
    prior: Prior
    evidence: float = np.inf
    assumed: str = ""

    @property
    def angular(self) -> bool:
        """Whether only directions are known: residuals are sines of angles, and nothing has a length."""
        return self.phantom.seen_as == "direction"

    @cached_property
    def jacobian(self) -> FloatArray:
        """Derivatives of the residuals used by small displacements, shape (n r, p)."""
        _, slopes = self.phantom.equations(self.points_used).at(self.chain)
        return slopes.reshape(-1, len(CHAIN))[:, columns_of(self.free)]

    @property
    def contradicts_prior(self) -> bool:
        """Whether the solution is far from the prior."""
        return bool(np.abs(self.prior.deviation(self.chain)).max() > _CONTRADICTS)

    @property
    def condition_number(self) -> float:
        """Condition number of the Jacobian with columns of unit length."""
        return condition_number(self.jacobian)

    @property
    def corner_slopes(self) -> FloatArray:
        """Derivatives of the image's corners, mm, by the displacements of `CHAIN`, shape (4, 3, 14)."""
        corners = _corners(self.points_used)
        slopes = np.zeros((4, 3, len(CHAIN)))
        slopes[:, 0, 0], slopes[:, 1, 1] = corners.T
        slopes[:, :, 2:5] = np.eye(3)
        slopes[:, :, 7:4:-1] = -skew(np.column_stack([corners * self.chain.pixel_mm, np.zeros(4)]))
        return slopes

    @cached_property
    def adequacy(self) -> Adequacy:
        """Whether the motion was sufficient, and what is missing."""
        return judge(self)

    @cached_property
    def points_used(self) -> ImagePoints:
        """The points that the solution is made from."""
        return self.points[self.used]

    @property
    def rms(self) -> float:
        """Root mean square residual of the points used."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))

    @cached_property
    def full_covariance(self) -> FloatArray:
        """Covariance of all of `CHAIN`, zero for parameters held, shape (14, 14)."""
        return in_chain(self.free, self.covariance)

    def image_covariance(self, names: Sequence[str]) -> FloatArray:
        """Covariance of some of the parameters, zero for those held."""
        columns = columns_of(names)
        return self.full_covariance[np.ix_(columns, columns)]


@dataclass(frozen=True)
class Problem:
    """Calibration problem: phantom, free parameters and prior.

    Parameters
    ----------
    phantom : Phantom
    probe : tuple of str
        Which of `PROBE` to estimate, besides all that the phantom determines.
    outlier_sigma : float
        Frames whose largest residual exceeds so many robust standard deviations are left out.
    prior : Prior
        What is known of them, and the pixel size where it is not estimated.
    """

    phantom: Phantom
    probe: tuple[str, ...] = PROBE
    outlier_sigma: float = OUTLIER_SIGMA
    prior: Prior = UNKNOWN

    @classmethod
    def of(
        cls,
        phantom: Phantom,
        pixel_mm: FloatArray | None,
        settings: PixelSettings,
        pixel_error: float = np.inf,
    ) -> Problem:
        """The problem of a phantom as settings say, with the scanner's pixel size if that is known.

        Raises
        ------
        InvalidInputError
            If the pixel size is neither fitted nor given.
        """
        if settings.fixed_pixels and pixel_mm is None:
            raise InvalidInputError(
                "pixel_mm: expected the scanner's pixel size unless it is fitted, got none"
            )
        probe, pixel_error = (POSE, 1.0) if settings.fixed_pixels else (PROBE, pixel_error)
        return cls(phantom, probe, settings.outlier_sigma, Prior.of(pixel_mm, pixel_error))

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters estimated."""
        return (*self.probe, *self.phantom.unknowns)

    def solve(self, points: ImagePoints, start: Chain) -> Solution:
        """Refine a start until residuals are least, leaving out frames that contradict the others.

        Raises
        ------
        InsufficientDataError
            If there are too few points, or fewer than half of the frames agree.
        """
        chain, inliers = self.fit(points, start)
        phantom, free = self.phantom, self.free
        equations = phantom.equations(points)
        agreeing = equations[inliers]
        refit, _, covariance = fit_noise(agreeing, chain, free, phantom.seen_as, self.prior)
        if np.abs(np.log(refit.pixel_mm / chain.pixel_mm)).max() < _SIZE_CHANGE:
            chain = refit
        if phantom.unknowns:
            # Where the phantom is, as the readings say on average: what wanders is not in its place.
            chain = agreeing.least_squares(chain, phantom.unknowns)
        residuals = equations.residuals(chain)
        sigma = sigma_of(residuals[inliers])
        return Solution(chain, phantom, free, covariance, points, inliers, residuals, sigma, self.prior)

    def fit(self, points: ImagePoints, start: Chain) -> tuple[Chain, BoolArray]:
        """Least squares of the frames that do not contradict the others, and which points those are."""
        equations = self.phantom.equations(points)
        # What is known somewhat is held while wrong frames still pull.
        first = [name for name in self.free if np.isinf(self.prior.sigma[CHAIN.index(name)])]
        chain = equations.least_absolute(start, first)
        residuals = equations.residuals(chain)
        inliers = _within(residuals, points.frame, self._limit(residuals))
        for _ in range(_ROUNDS):
            frames, agreeing = len(points.frames), len(np.unique(points.frame[inliers]))
            if 2 * agreeing <= frames:
                raise InsufficientDataError(
                    f"expected most frames to agree on one calibration, got {agreeing} of {frames}: {DOUBTS}"
                )
            sigma, before = sigma_of(residuals[inliers]), inliers
            chain = equations[inliers].least_squares(chain, self.free, self.prior, sigma)
            residuals = equations.residuals(chain)
            inliers = _within(residuals, points.frame, self._limit(residuals[before]))
            if (inliers == before).all():
                break
        return chain, inliers

    def _limit(self, residuals: FloatArray) -> float:
        """Largest residual that agrees with the others: Student's quantile as rare as `outlier_sigma`."""
        count = residuals.size
        free = max(count - len(self.free), 1)
        quantile = abs(float(stdtrit(free, ndtr(-self.outlier_sigma))))
        return quantile * sigma_of(residuals) * float(np.sqrt(count / free))

    def best(self, points: ImagePoints, starts: Sequence[Chain]) -> Solution:
        """Solve from several starts and their discrete alternatives; the best solution, with its rival.

        Where a motion is missing, an image turned by half about one of its axes shows nearly the same: the
        lines of a plane that is always equally deep do not tell the image from its in-plane mirror.

        Raises
        ------
        InsufficientDataError
            If there are too few frames, or fewer than half of them agree.
        """
        frames, equations = len(points.frames), self.phantom.equations(points).offsets.size
        fewest = max(_FEWEST_FRAMES, ceil(_FEWEST_EQUATIONS * len(self.free) * frames / max(equations, 1)))
        if frames < fewest:
            raise InsufficientDataError(
                f"expected the phantom in at least {fewest} frames ({_FEWEST_EQUATIONS} equations to each of "
                f"{len(self.free)} unknowns), got it in {frames}"
            )
        few = points.of_some_frames(SOME_FRAMES)
        chains = self._ends(few, starts)
        if not chains:
            return self.solve(points, starts[0])
        chains += self._ends(few, half_turns(self._sorted(few, chains)[0], few, self.phantom))
        best, *rivals = self._sorted(few, chains)
        solution = self.solve(points, best)
        nearest = [chain for chain in rivals if are_distinct(best, chain, few, self.phantom)][:1]
        for rival in self._ends(points, nearest):
            if are_distinct(solution.chain, rival, points, self.phantom):
                cost, rival_cost = self._costs(solution.points_used, [solution.chain, rival])
                if rival_cost < cost:
                    solution = self.solve(points, rival)
                return replace(solution, evidence=abs(float(rival_cost - cost)))
        return solution

    def _ends(self, points: ImagePoints, starts: Sequence[Chain]) -> list[Chain]:
        """Where iterations from each start end, unless most points contradict it there."""
        ends = []
        for start in starts:
            with suppress(InsufficientDataError):
                ends.append(self.fit(points, start)[0])
        return ends

    def _sorted(self, points: ImagePoints, chains: Sequence[Chain]) -> list[Chain]:
        """Chains sorted by cost, the best first."""
        return [chains[k] for k in np.argsort(self._costs(points, chains), kind="stable")]

    def _costs(self, points: ImagePoints, chains: Sequence[Chain]) -> FloatArray:
        """Sums of squared residuals, each cut off, in the variance of an independent one at the least sum."""
        equations, lines = self.phantom.equations(points), self.phantom.seen_as == "line"
        residuals = [equations.residuals(c) / (c.pixel_mm[1] if lines else 1.0) for c in chains]
        cut = _CUT * min(sigma_of(r) for r in residuals)
        sums = np.array([float(np.sum(np.minimum(r**2, cut**2))) for r in residuals])
        best = np.clip(residuals[int(np.argmin(sums))], -cut, cut)
        independent = best.size / together(best, points.frame)
        sums *= independent / max(float(sums.min()), _SMALLEST_SIGMA**2)
        return sums + [float(np.sum(self.prior.deviation(chain) ** 2)) for chain in chains]


def sigma_of(residuals: FloatArray) -> float:
    """Robust standard deviation of residuals, not less than rounding."""
    return robust_sigma(residuals, _SMALLEST_SIGMA)


def _within(residuals: FloatArray, frame: IntArray, limit: float) -> BoolArray:
    """Points of the frames none of whose residuals exceeds `limit`."""
    return ~np.isin(frame, frame[(np.abs(residuals) > limit).any(axis=1)])


def together(residuals: FloatArray, frame: IntArray) -> float:
    """Number of residuals, shape (n, r), per independent one, by correlation in frames and time."""
    index = np.unique(frame, return_inverse=True)[1]
    sums = np.stack([np.bincount(index, column) for column in residuals.T])
    energy = float(np.sum(residuals**2))
    times = [autocorrelation_time(s) * float(s @ s) for s in sums]
    return max(1.0, sum(times) / energy) if energy > 0 else 1.0


def autocorrelation_time(residuals: FloatArray) -> float:
    """Autocorrelation time of residuals: m residuals hold m / this independent ones.

    One plus twice the correlations with neighbours, up to the first lag at which there is none.

    Parameters
    ----------
    residuals : ndarray, shape (m,)
        In order, about zero.
    """
    energy, time = max(float(residuals @ residuals), np.finfo(float).tiny), 1.0
    for lag in range(1, len(residuals) // 4):
        rho = float(residuals[lag:] @ residuals[:-lag]) / energy
        if rho <= 0:
            break
        time += 2.0 * rho
    return time


def half_turns(chain: Chain, points: ImagePoints, phantom: Phantom) -> list[Chain]:
    """The image turned by half about each of its axes through the middle of what it shows.

    About its z axis not where directions alone are known: they stay exactly as they are.
    """
    directions = phantom.seen_as == "direction"
    middle = np.append(np.median(points.pixels, axis=0) * chain.pixel_mm, 0.0) * (not directions)
    return [chain.half_turn(axis, middle) for axis in range(2 if directions else 3)]


def are_distinct(first: Chain, second: Chain, points: ImagePoints, phantom: Phantom) -> bool:
    """Whether two chains are two answers, not one: by where the image's corners are, or its axes point."""
    directions = phantom.seen_as == "direction"
    flat = np.eye(2) if directions else _corners(points)
    alike = [second, second.mirror()] if directions else [second]
    at, *others = (c.probe[:3, :2] @ (flat * c.pixel_mm).T + c.probe[:3, 3:] for c in (first, *alike))
    away = min(float(np.linalg.norm(places - at, axis=0).max()) for places in others)
    return away > _APART * float(np.linalg.norm(flat.max(axis=0) * first.pixel_mm))


def _corners(points: ImagePoints) -> FloatArray:
    """Corners of the image, pixels, taken to reach as far as points are in it, shape (4, 2)."""
    shares = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return np.asarray(shares * points.pixels.max(axis=0))
