"""Least squares whose residuals carry a sensor's wandering error: Ornstein-Uhlenbeck and white noise.

A sensor's error drifts over seconds, so that neighbouring residuals err alike and many of them say no more
than a few. The errors are the states of a Kalman filter that passes through the recording once for a whole
grid of sizes and time constants and turns residuals and Jacobian into innovations, which are independent;
the answers of the grid are averaged by their restricted likelihood.

References
----------
.. [1] G. E. Uhlenbeck and L. S. Ornstein, "On the theory of the Brownian motion", Phys. Rev. 36, 1930.
.. [2] H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal",
   Biometrika 58, 1971 (restricted likelihood).
.. [3] A. C. Harvey and G. D. A. Phillips, "Maximum likelihood estimation of regression models with
   autoregressive-moving average disturbances", Biometrika 66, 1979 (generalised least squares by the filter).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import MismatchError
from speckle3d.core.threads import in_parallel
from speckle3d.kernels.wander import COMPONENTS, LANES, attribute, innovations

WANDER = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Sizes tried: root mean square effect of the wandering error over the white noise of a residual."""

JITTER = (0.0, 0.5, 1.5)
"""Sizes tried of the error that is new in every frame and moves all its residuals together."""

STEADY = 0.5
"""Probability, before anything is measured, that nothing wanders."""

_TIMES = 4
"""Time constants tried, evenly spaced in logarithm."""

_SHORTEST, _LONGEST = 4.0, 2.0
"""Shortest and longest time constant tried: four frames, of which fewer look like white noise; twice the
recording, which looks like a straight line."""

_NEGLIGIBLE = 1e-4
"""Weight over the largest below which a size and a time have no say."""

_ROUNDED = 1e-18
"""Weight over the largest below which it adds nothing to a sum."""

_SINGULAR = 1e-15
"""Ratio of eigenvalues below which a direction counts as not determined."""

_SMALLEST = 1e-12
"""Residuals below are rounding: nothing wanders in them."""


@dataclass(frozen=True)
class SensorError:
    """How the errors of a sensor move residuals.

    Attributes
    ----------
    effects : ndarray, shape (m, k)
        Derivatives of the residuals by the k components of the error.
    proportions : sequence of ndarray, shape (k,)
        Standard deviations of the components, in proportion to each other; several are tried. A component
        of zero does not wander.
    """

    effects: FloatArray
    proportions: Sequence[FloatArray]


@dataclass(frozen=True)
class WanderingFit:
    """An answer of linear least squares with wandering errors, averaged over the grid.

    Attributes
    ----------
    step : ndarray, shape (p,)
        Added to the parameters, it makes ``residuals + jacobian @ step`` least.
    covariance : ndarray, shape (p, p)
    white : float
        Standard deviation of the white noise of a residual.
    wander : float
        Root mean square effect of the wandering error on a residual, in the residuals' unit.
    time_s : float
        Its time constant, in the unit of the times given; NaN where nothing wanders.
    spread : ndarray, shape (k,)
        Variances of the components of the sensor's error in a frame, wandering and jitter together.
    likely : ndarray of bool, shape (g,)
        Which sizes and times of the grid have a say.
    """

    step: FloatArray
    covariance: FloatArray
    white: float
    wander: float
    time_s: float
    spread: FloatArray
    likely: BoolArray


@dataclass(frozen=True)
class _Grid:
    """Size of wandering and of jitter relative to white noise, time constant, and proportion, each (g,)."""

    wander: FloatArray
    jitter: FloatArray
    time_s: FloatArray
    unit: FloatArray
    """Variance of each component of the error whose root mean square effect is one, shape (g, k)."""
    prior: FloatArray

    def __getitem__(self, some: BoolArray) -> _Grid:
        return _Grid(
            self.wander[some], self.jitter[some], self.time_s[some], self.unit[some], self.prior[some]
        )


def wandering_fit(
    jacobian: FloatArray,
    residuals: FloatArray,
    group: IntArray,
    time_s: FloatArray,
    error: SensorError,
    jitter: Sequence[float] = JITTER,
    prior: FloatArray | None = None,
    excess: FloatArray | None = None,
    likely: BoolArray | None = None,
) -> WanderingFit:
    """Solve linear least squares whose residuals carry white noise and a sensor's wandering error.

    Parameters
    ----------
    jacobian : ndarray, shape (m, p)
    residuals : ndarray, shape (m,)
    group : ndarray of int, shape (m,)
        Frame of each residual, ascending; residuals of a frame have one sensor reading.
    time_s : ndarray, shape (m,)
        Of each residual's frame.
    error : SensorError
    jitter : sequence of float
        Sizes of the error that is new in each frame to try (`JITTER`); zero alone where a frame has one
        residual.
    prior : ndarray, shape (p, p), optional
        Inverse covariance of what is known of the parameters besides, in the units of the parameters.
    excess : ndarray, shape (p,), optional
        By how much the present parameters exceed what is known; by default not at all.
    likely : ndarray of bool, shape (g,), optional
        `WanderingFit.likely` of the same problem nearby: others of the grid are left out, for time.

    Raises
    ------
    MismatchError
        If the arrays are not of one length.
    """
    lengths = {len(jacobian), len(residuals), len(group), len(time_s), len(error.effects)}
    if len(lengths) > 1:
        raise MismatchError(f"expected as many rows of each, got {sorted(lengths)}")
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    whole = _grid(error, time_s[starts], jitter)
    tried = np.ones(len(whole.prior), dtype=bool) if likely is None else likely
    grid = whole[tried]
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    known = np.zeros((len(scale), len(scale))) if prior is None else prior / np.outer(scale, scale)
    columns = np.column_stack([jacobian / scale, residuals])
    normal, log_determinant = _innovations(columns, error.effects, starts, time_s, grid)
    matrix, pull, energy = normal[:, :-1, :-1], normal[:, :-1, -1], normal[:, -1, -1]
    free = max(len(residuals) - len(scale), 1)
    sizes, axes = np.linalg.eigh(matrix)
    along = np.einsum("gij,gi->gj", axes, pull)
    known_sizes = np.where(sizes > _SINGULAR * sizes[:, -1:], sizes, np.inf)
    left = np.maximum(energy - (along**2 / known_sizes).sum(axis=1), 0.0)
    variance = np.maximum(left / free, _SMALLEST**2)
    volume = np.log(np.maximum(sizes, _SINGULAR * sizes[:, -1:] + _SMALLEST)).sum(axis=1)
    likelihood = -0.5 * (free * np.log(variance) + log_determinant + volume)
    weight = grid.prior * np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    # Points of the grid whose weight is lost in rounding need no answer.
    some = weight > _ROUNDED * weight.max()
    back = np.zeros(len(scale)) if excess is None else known @ (excess * scale)
    precision = matrix[some] / variance[some, None, None] + known
    spread = np.linalg.pinv(precision, rcond=_SINGULAR, hermitian=True)
    steps = -np.einsum("gij,gj->gi", spread, pull[some] / variance[some, None] + back)
    share = weight[some]
    step = share @ steps
    apart = steps - step
    covariance = np.einsum("g,gij->ij", share, spread) + (share * apart.T) @ apart
    wandering = weight * (grid.wander > 0)
    time = float(np.exp(wandering @ np.log(grid.time_s) / wandering.sum())) if wandering.sum() > 0 else np.nan
    return WanderingFit(
        step / scale,
        covariance / np.outer(scale, scale),
        float(np.sqrt(weight @ variance)),
        float(np.sqrt(weight @ (variance * grid.wander**2))),
        time,
        (weight * variance * (grid.wander**2 + grid.jitter**2)) @ grid.unit,
        np.isin(np.arange(len(tried)), np.flatnonzero(tried)[weight > _NEGLIGIBLE * weight.max()]),
    )


def attributed(
    residuals: FloatArray, group: IntArray, error: SensorError, fit: WanderingFit
) -> tuple[FloatArray, FloatArray]:
    """Divide residuals between the sensor and the image, each frame by itself: their expected errors.

    Parameters
    ----------
    residuals : ndarray, shape (m,)
    group : ndarray of int, shape (m,)
        Frame of each residual, ascending.

    Returns
    -------
    sensor : ndarray, shape (m, k)
        Error of the sensor in the frame of each residual.
    image : ndarray, shape (m,)
        What is left for the image.
    """
    sensor, image = np.empty(error.effects.shape), np.empty(residuals.shape)
    starts = np.flatnonzero(np.diff(group, prepend=group[0] - 1))
    attribute(
        np.ascontiguousarray(residuals),
        np.ascontiguousarray(error.effects),
        np.append(starts, len(group)),
        np.ascontiguousarray(fit.spread),
        max(fit.white, _SMALLEST) ** 2,
        sensor,
        image,
    )
    return sensor, image


def _grid(error: SensorError, frame_time_s: FloatArray, jitter: Sequence[float]) -> _Grid:
    span = max(float(np.ptp(frame_time_s)), _SMALLEST)
    spacing = float(np.median(np.diff(frame_time_s))) if len(frame_time_s) > 1 else span
    shortest = min(max(_SHORTEST * spacing, _SMALLEST), span)
    times = np.geomspace(shortest, _LONGEST * span, _TIMES)
    units = []
    for proportion in error.proportions:
        effect = np.mean((error.effects * proportion) ** 2) * len(proportion)
        units.append(np.asarray(proportion) ** 2 / max(float(effect), _SMALLEST**2))
    rows = [
        (wander, shake, time, unit)
        for wander in WANDER
        for shake in jitter
        for time in (times if wander > 0 else times[:1])
        for unit in (units if wander > 0 or shake > 0 else units[:1])
    ]
    wander, shake, time, unit = (np.array(column) for column in zip(*rows, strict=True))
    still = wander == 0
    prior = np.where(still, STEADY / max(still.sum(), 1), (1.0 - STEADY) / max((~still).sum(), 1))
    return _Grid(wander, shake, time, unit, prior)


def _innovations(
    columns: FloatArray, effects: FloatArray, starts: IntArray, time_s: FloatArray, grid: _Grid
) -> tuple[FloatArray, FloatArray]:
    """Products of the columns' innovations, (g, p + 1, p + 1), and logarithms of their variance, (g,)."""
    count, wide = len(grid.time_s), columns.shape[1]
    blocks = -(-count // LANES)
    padded = np.minimum(np.arange(blocks * LANES), count - 1)
    moving = np.zeros((len(columns), COMPONENTS))
    moving[:, : effects.shape[1]] = effects
    unit = np.zeros((blocks * LANES, COMPONENTS))
    unit[:, : effects.shape[1]] = grid.unit[padded]

    def in_blocks(values: FloatArray) -> FloatArray:
        return np.ascontiguousarray(np.swapaxes(values.reshape(blocks, LANES, -1), 1, 2))

    pauses_s = np.maximum(np.diff(time_s[starts], prepend=time_s[starts[0]]), 0.0)
    constants_s, which = np.unique(grid.time_s[padded], return_inverse=True)
    kept = np.exp(-pauses_s[:, None] / constants_s)[:, which].T
    stationary = unit * (grid.wander[padded] ** 2)[:, None]
    shaken = unit * (grid.jitter[padded] ** 2)[:, None]
    normal = np.empty((blocks, wide, wide, LANES))
    log_determinant = np.empty((blocks, LANES))
    given = (
        np.ascontiguousarray(columns),
        moving,
        np.append(starts, len(columns)),
        in_blocks(kept),
        in_blocks(stationary),
        in_blocks(shaken),
    )

    def some(first: int, stop: int) -> None:
        innovations(*given, first, stop, normal, log_determinant)

    in_parallel(some, blocks)
    normal = np.moveaxis(normal, 3, 1).reshape(blocks * LANES, wide, wide)[:count]
    return normal, log_determinant.ravel()[:count]
