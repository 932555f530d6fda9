"""The solver that all calibrations with a phantom share: robust least squares of the chain's parameters.

Solutions are refined in frames that lie on the image and on the phantom, where no angle becomes singular, and
frames that contradict the others are left out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.chain import (
    POSE,
    PROBE,
    SCALES,
    Chain,
    ChainSolution,
    ImagePoints,
    Phantom,
    PixelPrior,
    free_jacobian,
)
from calibration.equations import BareChain, Equations, columns_of
from calibration.profile import widened
from calibration.wandering import settle
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.leastsquares import (
    Fit,
    condition_number,
    huber_weights,
    robust_sigma,
)

SOME_FRAMES = 100
"""Number of frames that choose among starting points; the answer is refined from all frames afterwards."""

OUTLIER_SIGMA = 4.0
"""Frames whose residual exceeds this many robust standard deviations are dropped: of Gaussian residuals of
one size one in 16,000; of dots, which are known less well out of the image than in it, one in a hundred."""

_NEARLY_ABSOLUTE = 0.06745
"""Limit of Huber's weights, a tenth of the median: nearly all residuals count by their absolute values."""
_REWEIGHTINGS = 8
_SETTLED = 0.99
"""Reweighting ends when it lowers the mean absolute residual by less."""
_RUNAWAY = 2.0
"""Steps that take errors for wandering leave residuals larger by a tenth, rarely by a half."""
_RESIZED = 0.1
"""And they change pixel sizes by a few percent."""
_FREE_ROUNDS = 5
"""After so many rounds, frames may be dropped but not taken back, so that the rounds end."""
_TOLERANCE = 1e-9
_SMALLEST_SIGMA = 1e-7
"""Residuals of exact data are rounding; nothing in them is an outlier."""


def solve_chain(
    points: ImagePoints,
    phantom: Phantom,
    start: Chain,
    probe: tuple[str, ...] = PROBE,
    outlier_sigma: float = OUTLIER_SIGMA,
    prior: PixelPrior | None = None,
) -> ChainSolution:
    """Refine a chain until the phantom's residuals are least, leaving out frames that contradict the others.

    Parameters
    ----------
    points : ImagePoints
    phantom : Phantom
    start : Chain
        From which the solution is reached; its held parameters stay.
    probe : tuple of str
        Which of `PROBE` to estimate; all that the phantom determines of `TARGET` are estimated besides.
    outlier_sigma : float
        Frames whose largest residual exceeds so many robust standard deviations are dropped.
    prior : PixelPrior, optional
        Counts as further residuals where the pixel size is estimated.

    Raises
    ------
    InsufficientDataError
        If there are too few points, or fewer than half of them agree.
    """
    free = (*probe, *phantom.determined)
    prior = prior if "s_x" in free else None
    chain, used = agreed(points, phantom, start, free, outlier_sigma, prior)
    least = sigma_of(residuals_of(points[used], phantom, chain))
    settled, noise = settle(points[used], phantom, chain, free, prior)
    # Where the motion leaves the answer open, linear steps run away; the covariance says how open it is.
    bigger = np.abs(np.log(settled.pixel_mm / chain.pixel_mm)).max()
    if sigma_of(residuals_of(points[used], phantom, settled)) < _RUNAWAY * least and bigger < _RESIZED:
        chain = settled
    if phantom.determined:
        # Where the phantom is, as the readings say on average: what wanders is not in its place.
        chain = refined(points[used], phantom, chain, phantom.determined)
    noise = replace(noise, covariance=widened(points[used], phantom, chain, free, noise.covariance))
    residuals = residuals_of(points, phantom, chain)
    sigma = sigma_of(residuals[used])
    # Once more from the answer: the covariance holds in the frames where the last refinement began.
    fit = fitted(points[used], phantom, chain, free, prior=prior, sigma=sigma)
    return ChainSolution(
        chain,
        phantom,
        free,
        fit,
        noise,
        points,
        used,
        residuals,
        sigma,
        condition_number(free_jacobian(points[used], phantom, chain, free)),
        prior,
    )


def agreed(
    points: ImagePoints,
    phantom: Phantom,
    start: Chain,
    free: tuple[str, ...],
    outlier_sigma: float,
    prior: PixelPrior | None = None,
) -> tuple[Chain, BoolArray]:
    """Least squares of the frames that do not contradict the others, and which points those are."""
    equations = Equations.of(points, phantom)
    chain = _first_guess(equations, BareChain.of(start), at_first(free, prior))
    residuals = equations.residuals(chain)
    used = _frames_within(residuals, points.frame, outlier_sigma * sigma_of(residuals))
    in_rows = phantom.seen_as == "line"
    round_ = 0
    while True:
        _require_majority(used, points)
        sigma = sigma_of(residuals[used])
        chain = _refined(equations[used], chain, free, None, _TOLERANCE, prior, sigma, in_rows)
        residuals = equations.residuals(chain)
        agreeing = _frames_within(residuals, points.frame, outlier_sigma * sigma_of(residuals[used]))
        if round_ >= _FREE_ROUNDS:
            agreeing &= used
        if (agreeing == used).all():
            return chain.chain, used
        used, round_ = agreeing, round_ + 1


def at_first(free: tuple[str, ...], prior: PixelPrior | None) -> tuple[str, ...]:
    """Those to estimate while wrong frames still pull: not pixel sizes that are known somewhat."""
    return tuple(name for name in free if prior is None or name not in SCALES)


def sigma_of(residuals: FloatArray) -> float:
    """Robust standard deviation of residuals, not less than rounding."""
    return robust_sigma(residuals, _SMALLEST_SIGMA)


def probe_parameters(
    fit_pixels: bool, pixel_mm: FloatArray | None
) -> tuple[tuple[str, ...], FloatArray | None]:
    """Which of `PROBE` to estimate, and the pixel size to hold, if any.

    Raises
    ------
    InvalidInputError
        If the pixel size is neither fitted nor given.
    """
    if fit_pixels:
        return PROBE, None
    if pixel_mm is None:
        raise InvalidInputError("pixel_mm: expected the scanner's pixel size unless it is fitted, got none")
    return POSE, np.asarray(pixel_mm, dtype=float)


def first_guess(
    points: ImagePoints,
    phantom: Phantom,
    start: Chain,
    free: tuple[str, ...],
    rounds: int = _REWEIGHTINGS,
) -> Chain:
    """Nearly least absolute residuals, by reweighting at most so often, so that wrong frames pull little."""
    return _first_guess(Equations.of(points, phantom), BareChain.of(start), free, rounds).chain


def _first_guess(
    equations: Equations, start: BareChain, free: tuple[str, ...], rounds: int = _REWEIGHTINGS
) -> BareChain:
    chain, before = start, np.inf
    for _ in range(rounds):
        size = np.abs(equations.residuals(chain))
        if size.mean() > _SETTLED * before:
            break
        before = size.mean()
        weights = np.sqrt(huber_weights(size / sigma_of(size), _NEARLY_ABSOLUTE))
        chain = _refined(equations, chain, free, weights, tolerance=1e-3)
    return chain


def residuals_of(points: ImagePoints, phantom: Phantom, chain: Chain) -> FloatArray:
    """Return what does not vanish in the phantom's frame, shape (n, r)."""
    return Equations.of(points, phantom).residuals(BareChain.of(chain))


def refined(points: ImagePoints, phantom: Phantom, chain: Chain, free: tuple[str, ...]) -> Chain:
    """One least-squares solution, in frames that lie where `chain` says the image and the phantom are.

    There all angles start at zero: far from where fixed angles become singular, and well scaled.
    """
    return _refined(Equations.of(points, phantom), BareChain.of(chain), free).chain


def fitted(
    points: ImagePoints,
    phantom: Phantom,
    chain: Chain,
    free: tuple[str, ...],
    prior: PixelPrior | None = None,
    sigma: float = 1.0,
) -> Fit:
    """The solution of `refined` with its residuals and derivatives, in the frames where it began.

    The prior's deviations are weighed against residuals of standard deviation `sigma`, and follow them.
    """
    equations, columns, in_rows = Equations.of(points, phantom), columns_of(free), phantom.seen_as == "line"
    begun = BareChain.of(chain)
    known = equations.known(prior, sigma, in_rows)
    found, steps, converged = equations.least_squares(begun, columns, None, known, _TOLERANCE)
    values, jacobian = equations.near(begun).derivatives(found, columns)
    if prior is not None:
        if in_rows:
            # Lines err by rows: in millimetres, an image that shrinks to nothing would leave no residual.
            larger = found[1] / begun.pixel_mm[1]
            jacobian, values = jacobian / larger, values / larger
            jacobian[:, free.index("s_y")] -= values / found[1]
        extra = (columns == np.arange(2)[:, None]) * sigma / (prior.error * prior.pixel_mm[:, None])
        values, jacobian = np.append(values, sigma * prior.deviation(found[:2])), np.vstack([jacobian, extra])
    return Fit(found[columns], free, values, jacobian, steps, converged)


def _refined(
    equations: Equations,
    chain: BareChain,
    free: tuple[str, ...],
    weights: FloatArray | None = None,
    tolerance: float = _TOLERANCE,
    prior: PixelPrior | None = None,
    sigma: float = 1.0,
    in_rows: bool = False,
) -> BareChain:
    """The answer of `refined` on bare arrays, each equation times its weight, shape (n, r)."""
    known = equations.known(prior, sigma, in_rows)
    found, _, _ = equations.least_squares(chain, columns_of(free), weights, known, tolerance)
    return chain.moved_to(found)


def _frames_within(residuals: FloatArray, frame: IntArray, limit: float) -> BoolArray:
    """Points of the frames none of whose residuals exceeds `limit`."""
    wrong = np.unique(frame[(np.abs(residuals) > limit).any(axis=1)])
    return ~np.isin(frame, wrong)


def _require_majority(used: BoolArray, points: ImagePoints) -> None:
    frames, agreeing = len(points.frames), len(points[used].frames)
    if 2 * agreeing <= frames:
        raise InsufficientDataError(
            f"expected most frames to agree on one calibration, got {agreeing} of {frames}: do the images "
            "and the sensor readings belong together, and is the phantom the one named?"
        )
