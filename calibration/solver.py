"""The solver that all calibrations with a phantom share: robust least squares of the chain's parameters.

Solutions are refined in frames that lie on the image and on the phantom, where no angle becomes singular, and
frames that contradict the others are left out.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import lru_cache

import numpy as np

from calibration.chain import (
    CHAIN,
    POSE,
    PROBE,
    Chain,
    ChainSolution,
    ImagePoints,
    Phantom,
    free_jacobian,
    residuals_and_jacobian,
    sensor_error,
)
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.leastsquares import (
    Fit,
    condition_number,
    huber_weights,
    levenberg_marquardt,
    robust_sigma,
)
from speckle3d.core.wander import JITTER, WanderingFit, wandering_fit

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
_WANDERING_STEPS = 2
"""The first finds the answer, the second its covariance there."""
_FREE_ROUNDS = 5
"""After so many rounds, frames may be dropped but not taken back, so that the rounds end."""
_SMALLEST_SIGMA = 1e-7
"""Residuals of exact data are rounding; nothing in them is an outlier."""


def solve_chain(
    points: ImagePoints,
    phantom: Phantom,
    start: Chain,
    probe: tuple[str, ...] = PROBE,
    outlier_sigma: float = OUTLIER_SIGMA,
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

    Raises
    ------
    InsufficientDataError
        If there are too few points, or fewer than half of them agree.
    """
    free = (*probe, *phantom.determined)
    chain = first_guess(points, phantom, start, free)
    residuals = residuals_of(points, phantom, chain)
    used = _frames_within(residuals, points.frame, outlier_sigma * sigma_of(residuals))
    for round_ in itertools.count():
        _require_majority(used, points)
        chain, _, _ = refined(points[used], phantom, chain, free)
        residuals = residuals_of(points, phantom, chain)
        sigma = sigma_of(residuals[used])
        agreeing = _frames_within(residuals, points.frame, outlier_sigma * sigma)
        if round_ >= _FREE_ROUNDS:
            agreeing &= used
        if (agreeing == used).all():
            break
        used = agreeing
    chain, noise = _with_wandering_errors(points[used], phantom, chain, free)
    residuals = residuals_of(points, phantom, chain)
    # Once more from the answer: the covariance holds in the frames where the last refinement began.
    _, fit, _ = refined(points[used], phantom, chain, free)
    return ChainSolution(
        chain,
        phantom,
        free,
        fit,
        noise,
        points,
        used,
        residuals,
        sigma_of(residuals[used]),
        condition_number(free_jacobian(points[used], phantom, chain, free)),
    )


def _with_wandering_errors(
    points: ImagePoints, phantom: Phantom, chain: Chain, free: tuple[str, ...]
) -> tuple[Chain, WanderingFit]:
    """Steps from a least-squares solution to the one that knows that the sensor's errors wander."""
    for _ in range(_WANDERING_STEPS):
        noise = wandering_noise(points, phantom, chain, free)
        chain = moved_by(chain, free, noise.step)
    return chain, noise


def wandering_noise(
    points: ImagePoints,
    phantom: Phantom,
    chain: Chain,
    free: tuple[str, ...],
    more: FloatArray | None = None,
) -> WanderingFit:
    """One step of least squares that knows that the sensor's errors wander, and its covariance.

    Parameters
    ----------
    more : ndarray, shape (n r, k), optional
        Derivatives of the residuals by further parameters, which come after the free ones.
    """
    residuals, jacobian = near_jacobian(points, phantom, chain, free)
    several = residuals.size // len(points)
    return wandering_fit(
        jacobian if more is None else np.column_stack([jacobian, more]),
        residuals,
        np.repeat(points.frame, several),
        np.repeat(points.times, several),
        sensor_error(points, phantom, chain),
        (0.0,) if residuals.size == len(points.frames) else JITTER,
    )


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


def first_guess(points: ImagePoints, phantom: Phantom, start: Chain, free: tuple[str, ...]) -> Chain:
    """Nearly least absolute residuals, by reweighting, so that wrong frames pull little."""
    chain, before = start, np.inf
    for _ in range(_REWEIGHTINGS):
        size = np.abs(residuals_of(points, phantom, chain))
        if size.mean() > _SETTLED * before:
            break
        before = size.mean()
        weights = np.sqrt(huber_weights(size / sigma_of(size), _NEARLY_ABSOLUTE))
        chain, _, _ = refined(points, phantom, chain, free, weights, tolerance=1e-3)
    return chain


def residuals_of(points: ImagePoints, phantom: Phantom, chain: Chain) -> FloatArray:
    """Return what does not vanish in the phantom's frame, shape (n, r)."""
    return residuals_and_jacobian(chain.parameters(), points, phantom)[0]


def refined(
    points: ImagePoints,
    phantom: Phantom,
    chain: Chain,
    free: tuple[str, ...],
    weights: FloatArray | None = None,
    tolerance: float = 1e-9,
) -> tuple[Chain, Fit, FloatArray]:
    """One least-squares solution, in frames that lie where `chain` says the image and the phantom are.

    There all angles start at zero: far from where fixed angles become singular, and well scaled.
    """
    near = replace(points, world_from_sensor=chain.target_from_image(points))
    columns = np.array([CHAIN.index(name) for name in free])
    origin = _origin(chain)
    scale = 1.0 if weights is None else weights

    @lru_cache(maxsize=2)
    def at(x: bytes) -> tuple[FloatArray, FloatArray]:
        full = origin.copy()
        full[columns] = np.frombuffer(x)
        values, jacobian = residuals_and_jacobian(full, near, phantom)
        kept = jacobian[:, :, columns] * (scale if weights is None else weights[:, :, None])
        return (values * scale).ravel(), kept.reshape(-1, len(columns))

    def both(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return at(x.tobytes())

    fit = levenberg_marquardt(
        lambda x: both(x)[0].copy(), origin[columns], lambda x: both(x)[1].copy(), free, tolerance=tolerance
    )
    found = origin.copy()
    found[columns] = fit.parameters
    return _moved_to(chain, found), fit, both(fit.parameters)[1]


def near_jacobian(
    points: ImagePoints, phantom: Phantom, chain: Chain, free: tuple[str, ...]
) -> tuple[FloatArray, FloatArray]:
    """Residuals, shape (n r,), and Jacobian, (n r, p), in frames that lie on the image and on the phantom."""
    near = replace(points, world_from_sensor=chain.target_from_image(points))
    residuals, jacobian = residuals_and_jacobian(_origin(chain), near, phantom)
    columns = [CHAIN.index(name) for name in free]
    return residuals.ravel(), jacobian.reshape(-1, len(CHAIN))[:, columns]


def moved_by(chain: Chain, free: tuple[str, ...], step: FloatArray) -> Chain:
    """Add a step in the free parameters, in frames that lie on the image and on the phantom."""
    parameters = _origin(chain)
    parameters[[CHAIN.index(name) for name in free]] += step
    return _moved_to(chain, parameters)


def _origin(chain: Chain) -> FloatArray:
    return np.concatenate([chain.pixel_mm, np.zeros(len(CHAIN) - 2)])


def _moved_to(chain: Chain, parameters: FloatArray) -> Chain:
    step = Chain.from_parameters(parameters)
    return Chain(
        step.pixel_mm,
        chain.sensor_from_image * step.sensor_from_image,
        step.target_from_world * chain.target_from_world,
    )


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
