"""Calibration with sensor errors correlated in time: estimate and covariance.

Plain least squares takes all errors for white and the sensor's poses for exact. But a sensor's error wanders
(Ornstein and Uhlenbeck), so that neighbouring frames say the same: residuals are whitened for a grid of sizes
and times of the wandering, and the answers of the grid are averaged by their restricted likelihood [2]_. And
the derivatives contain the poses' errors, which are in the residuals too, so that pixel sizes come out too
small: derivatives are taken at poses and points corrected by what the residuals say [1]_. A crossing of wires
is placed four times less well across the beam than along it, alike in neighbouring frames: that is one more
error that may wander.

References
----------
.. [1] F. R. Helmert, "Die Ausgleichungsrechnung nach der Methode der kleinsten Quadrate", Teubner, 1907;
   W. A. Fuller, "Measurement error models", Wiley, 1987.
.. [2] H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal",
   Biometrika 58, 1971 (restricted maximum likelihood, REML).
.. [3] A. C. Harvey and G. D. A. Phillips, Biometrika 66, 1979 (generalised least squares by a Kalman filter).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.points import SeenAs, columns_of
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.threads import ahead
from speckle3d.kernels.wander import innovations

if TYPE_CHECKING:
    from calibration.plane import Chain, Equations
    from calibration.solution import Prior

WANDER = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Sizes tried: root mean square effect of the wandering error over the white noise of a residual."""
JITTER = (0.0, 0.5, 1.5)
"""Sizes tried of the error that is new in every frame and moves all its residuals together."""
STEADY = 0.5
"""Probability, before anything is measured, that nothing wanders."""
PROPORTIONS_MM = (1.0, 4.0)
"""Errors of position over errors of rotation tried, mm per degree: trackers are specified at 0.25 mm with 0.5
degrees to 0.8 mm with 0.15 (TR 303, section 4.2)."""
ACROSS = (0.0, 2.0)
"""Errors of a point across the beam over the sensor's of position tried: of simulated threads, 0.29 mm
over 0.15; one in place of two changes errors and claims by less than a tenth."""

_TIMES = 4
_SHORTEST, _LONGEST = 4.0, 2.0
"""Time constants tried: from four frames, of which fewer look like white noise, to twice the recording, which
looks like a straight line."""
_NEGLIGIBLE = 1e-4
"""Weight over the largest below which a point of the grid has no say."""
_SINGULAR = 1e-15
"""Ratio of eigenvalues below which a direction counts as not determined."""
_SMALLEST = 1e-12
"""Residuals below are rounding: nothing wanders in them."""
_LEAST_EFFECT = 1e-9
"""Share of the largest squared effect below which an error along an axis moves no residual."""
_STEPS = 3
"""The first finds the answer, the second takes the errors out of the derivatives, the third the rest."""


@dataclass(frozen=True)
class Noise:
    """Estimated noise of sensor and image, with the parameters' step and covariance.

    Attributes
    ----------
    step : ndarray, shape (p,)
        Added to the parameters, it makes the residuals least.
    covariance : ndarray, shape (p, p)
    white : float
        Standard deviation of the white noise of a residual.
    spread : ndarray, shape (k,)
        Variances of the components of the error of a frame, wandering and jitter together.
    """

    step: FloatArray
    covariance: FloatArray
    white: float
    spread: FloatArray


def make_grid(
    effects: FloatArray, frame_time_s: FloatArray, proportions: Sequence[FloatArray], jitter: Sequence[float]
) -> FloatArray:
    """Grid of noise models, shape (g, 4 + k).

    Sizes of wandering and of jitter over the white noise, time constant, probability beforehand, and the
    variance of each component of an error whose root mean square effect is one.

    Parameters
    ----------
    effects : ndarray, shape (m, k)
        Derivatives of the residuals by the k components of a frame's error.
    proportions : sequence of ndarray, shape (k,)
        Standard deviations of the components, in proportion to each other.
    """
    span = max(float(np.ptp(frame_time_s)), _SMALLEST)
    spacing = float(np.median(np.diff(frame_time_s))) if len(frame_time_s) > 1 else span
    times = np.geomspace(min(max(_SHORTEST * spacing, _SMALLEST), span), _LONGEST * span, _TIMES)
    energy = np.mean(effects**2, axis=0)
    units = [shape**2 / max(float(energy @ shape**2), _SMALLEST**2) for shape in proportions]
    still = [(0.0, shake, times[0], unit) for shake in jitter for unit in (units if shake else units[:1])]
    wandering = product(WANDER, jitter, times, units)
    parts = [(STEADY, still), (1.0 - STEADY, list(wandering))]
    return np.array([(*sizes, share / len(part), *unit) for share, part in parts for *sizes, unit in part])


def fit_wandering(
    jacobian: FloatArray,
    residuals: FloatArray,
    effects: FloatArray,
    starts: IntArray,
    frame_time_s: FloatArray,
    grid: FloatArray,
    certainty: FloatArray | float = 0.0,
    excess: FloatArray | float = 0.0,
) -> tuple[Noise, FloatArray]:
    """Solve linear least squares whose residuals carry white noise and a sensor's wandering error.

    Parameters
    ----------
    jacobian, residuals : ndarray, shapes (m, p) and (m,)
    effects : ndarray, shape (m, k)
    starts : ndarray of int, shape (frames + 1,)
        First residual of each frame, and their number; residuals of a frame have one sensor reading.
    certainty : ndarray, shape (p,), optional
        Inverse variance of what is known of each parameter besides.
    excess : ndarray, shape (p,), optional
        By how much the present parameters exceed what is known.

    Returns
    -------
    noise : Noise
    grid : ndarray
        The part of the grid that has a say.
    """
    information = np.broadcast_to(certainty, jacobian.shape[1])
    columns = np.ascontiguousarray(np.column_stack([jacobian, residuals]))
    pauses_s = np.maximum(np.diff(frame_time_s, prepend=frame_time_s[0]), 0.0)

    def whiten(g: int) -> tuple[FloatArray, float]:
        wandering, jitter, constant_s, _, *unit = grid[g]
        variance, white = np.array(unit), np.empty_like(columns)
        decay = np.exp(-pauses_s / constant_s)
        sizes = variance * wandering**2, variance * jitter**2
        volume = float(innovations(columns, effects, starts, decay, *sizes, white))
        return white.T @ white, volume

    normal, log_determinant = map(np.array, zip(*ahead(whiten, range(len(grid))), strict=True))
    free = max(len(residuals) - jacobian.shape[1], 1)
    sizes, axes = np.linalg.eigh(normal[:, :-1, :-1])
    along = np.einsum("gij,gi->gj", axes, normal[:, :-1, -1])
    firm = np.where(sizes > _SINGULAR * sizes[:, -1:], sizes, np.inf)
    energy = np.maximum(normal[:, -1, -1] - (along**2 / firm).sum(axis=1), 0.0)
    variance = np.maximum(energy / free, _SMALLEST**2)
    volume = np.log(np.maximum(sizes, _SINGULAR * sizes[:, -1:] + _SMALLEST)).sum(axis=1)
    likelihood = np.log(grid[:, 3]) - 0.5 * (free * np.log(variance) + log_determinant + volume)
    weight = np.exp(likelihood - likelihood.max())
    likely = weight > _NEGLIGIBLE
    grid, normal, variance = grid[likely], normal[likely], variance[likely]
    weight = weight[likely] / weight[likely].sum()
    inverse = normal[:, :-1, :-1] / variance[:, None, None] + np.diag(information)
    spread = np.linalg.pinv(inverse, rcond=_SINGULAR, hermitian=True)
    pull = normal[:, :-1, -1] / variance[:, None] + information * excess
    steps = -np.einsum("gij,gj->gi", spread, pull)
    step = weight @ steps
    away = steps - step
    # Student's: of few residuals the variance itself is uncertain.
    spread *= free / max(free - 2, 1)
    covariance = np.einsum("g,gij->ij", weight, spread) + (weight * away.T) @ away
    noise = Noise(
        step,
        covariance,
        float(np.sqrt(weight @ variance)),
        (weight * variance * np.sum(grid[:, :2] ** 2, axis=1)) @ grid[:, 4:],
    )
    return noise, grid


def error_effects(equations: Equations, chain: Chain) -> FloatArray:
    """Derivatives of residuals by errors of a frame, shape (n, r, 7).

    Turns of the sensor about the world's axes, rad; its shifts, mm; the shift of a dot across the beam, mm.
    """
    points, in_world = equations.points, equations.rows @ chain.target[:3, :3]
    in_sensor = (points.pixels * chain.pixel_mm) @ chain.probe[:3, :2].T + chain.probe[:3, 3]
    arm = np.einsum("nij,nj->ni", points.turns, in_sensor)
    across = in_world @ points.turns @ chain.probe[:3, :1]
    return np.concatenate([np.cross(arm[:, None], in_world), in_world, across], axis=2)


def _error_axes(effects: FloatArray, seen_as: SeenAs) -> tuple[FloatArray, list[FloatArray]]:
    """Axes of errors that change residuals, shape (k, 7), and proportions of the errors along them, (k,).

    An error is as likely along any axis, so that axes may be chosen: of a plane, two turns and one shift.
    """
    # A point alone in its frame, which has three equations, may err across the beam.
    blocks = 1 if seen_as == "direction" else effects.shape[1] // 3 + 2
    axes = list[FloatArray]()
    for first, stop in ((0, 3), (3, 6), (6, 7))[:blocks]:
        block = effects[..., first:stop].reshape(-1, stop - first)
        sizes, along = np.linalg.eigh(block.T @ block)
        axes.append(np.pad(along.T[sizes > _LEAST_EFFECT * sizes[-1]], ((0, 0), (first, 7 - stop))))
    kind = np.repeat(range(blocks), [len(block) for block in axes])
    in_mm = PROPORTIONS_MM if blocks > 1 else PROPORTIONS_MM[:1]
    ratios = product(np.rad2deg(in_mm), ACROSS if blocks > 2 else ACROSS[:1])
    return np.concatenate(axes), [np.array([1.0, mm, mm * across])[kind] for mm, across in ratios]


def fit_noise(
    equations: Equations,
    chain: Chain,
    free: Sequence[str],
    seen_as: SeenAs,
    prior: Prior,
    slopes: FloatArray | None = None,
) -> tuple[Chain, FloatArray, FloatArray]:
    """Refit a least-squares solution with sensor errors correlated in time.

    Parameters
    ----------
    equations : Equations
        Without outliers, frames ascending.
    free : sequence of str, length p
        The parameters estimated.
    slopes : ndarray, shape (n r, k), optional
        Derivatives of the residuals by further parameters, which are zero so far.

    Returns
    -------
    chain : Chain
    further : ndarray, shape (k,)
        Values of the further parameters.
    covariance : ndarray, shape (p + k, p + k)
        Of the free parameters, and of the further ones after them.
    """
    points, columns, several = equations.points, columns_of(free), equations.rows.shape[1]
    first = np.flatnonzero(np.diff(points.frame, prepend=points.frame[0] - 1))
    starts = several * np.append(first, len(points))
    frame_time_s = points.times[starts[:-1] // several]
    further_slopes = np.zeros((equations.offsets.size, 0)) if slopes is None else slopes
    further, count = np.zeros(further_slopes.shape[1]), len(free)
    exact = equations
    effects = error_effects(equations, chain)
    axes, proportions = _error_axes(effects, seen_as)
    effects = effects.reshape(-1, 7) @ axes.T
    # Of one residual a frame, jitter is white noise.
    grid = make_grid(effects, frame_time_s, proportions, JITTER[:1] if seen_as == "direction" else JITTER)
    for _ in range(_STEPS):
        derivatives = exact.at(chain)[1]
        residuals = equations.residuals(chain).ravel() + further_slopes @ further
        jacobian = np.hstack([derivatives.reshape(len(further_slopes), -1)[:, columns], further_slopes])
        effects = error_effects(exact, chain).reshape(-1, 7) @ axes.T
        beliefs = prior.sigma[columns] ** -2.0, prior.displacement(chain)[columns]
        certainty, excess = (np.append(values, 0.0 * further) for values in beliefs)
        frames = starts, frame_time_s
        noise, grid = fit_wandering(jacobian, residuals, effects, *frames, grid, certainty, excess)
        residuals += jacobian @ noise.step
        step = np.zeros(derivatives.shape[-1])
        step[columns] = noise.step[:count]
        chain, further = chain.displace(step), further + noise.step[count:]
        exact = _denoise(equations, chain, residuals, effects, axes, starts, noise)
    return chain, further, noise.covariance


def _denoise(
    equations: Equations,
    chain: Chain,
    residuals: FloatArray,
    effects: FloatArray,
    axes: FloatArray,
    starts: IntArray,
    noise: Noise,
) -> Equations:
    """Take expected errors out of poses and pixels.

    Residuals, shape (m,), are divided between the errors of a frame, which along `axes` have these effects,
    and noise in the image, each frame by itself.
    """
    points, (n, several) = equations.points, equations.offsets.shape
    root, white = np.sqrt(noise.spread), max(noise.white, _SMALLEST) ** 2
    shapes = effects * root
    normal = np.add.reduceat(shapes[:, :, None] * shapes[:, None], starts[:-1]) + white * np.eye(len(root))
    pull = np.add.reduceat(shapes * residuals[:, None], starts[:-1])
    of_frame = root * np.linalg.solve(normal, pull[..., None])[..., 0]
    of_row = np.repeat(of_frame, np.diff(starts), axis=0)
    error = of_row[::several] @ axes
    poses = points.world_from_sensor.as_matrix()
    poses[:, :3, :3] = Rotation.from_rotvec(-error[:, :3]).as_matrix() @ points.turns
    poses[:, :3, 3] -= error[:, 3:6]
    in_image = equations.rows @ chain.target[:3, :3] @ points.turns @ chain.probe[:3, :2]
    # The smallest displacement in the image, mm, that explains what is left to it.
    square = in_image @ np.swapaxes(in_image, 1, 2) + 1e-9 * np.eye(several)
    image = (residuals - (effects * of_row).sum(axis=1)).reshape(n, several, 1)
    shift_mm = np.einsum("nr,nri->ni", np.linalg.solve(square, image)[..., 0], in_image)
    places = replace(
        points,
        world_from_sensor=RigidTransform(poses, normalize=False),
        pixels=points.pixels - (shift_mm + error[:, 6:] * [1.0, 0.0]) / chain.pixel_mm,
    )
    return replace(equations, points=places)
