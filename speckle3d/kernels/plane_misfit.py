"""Misfit of a plane to the correlations of a pair's patches, and its minimisation."""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.kernels.statistics import INTERPOLATION, PatchCurves, correlation_variance

_FAST = {"reassoc"}
"""For sums over patches. Predictions are exact: starts of fits lie on knots of the curves, where a distance
that is rounded otherwise has another slope. They say so, because a kernel that does not inherits its caller's
flags."""

_LEAST_MM = 0.05
"""Distance below which correlation is flat: sensitivities are not taken to be less than here."""
_RHO, LATERAL, _LEVER, _SPREAD, _SHARE, _GAIN, _CELLS = range(7)
"""Rows of the table of a pair's patches that take part."""


class EchoModels(NamedTuple):
    """Departure of patches' correlations from fully developed speckle's, rho_F, by pair.

    rho(d) = gain (share + (1 - share) sqrt(rho_F(d)))^2; see `speckle3d.motion.coherence`.

    Attributes
    ----------
    share, gain : float64, shape (e, p) or (1, p)
        With one row, it is that of all pairs.
    """

    share: FloatArray
    gain: FloatArray


class Levers(NamedTuple):
    """Lever arms of a plane's coefficients at each patch.

    Attributes
    ----------
    lateral_mm, lever_mm, spread_mm : float64, shape (p,)
        Of the slope along x; of the tilt; of the tilt again, in quadrature with the distance: what turning
        alone decorrelates.
    """

    lateral_mm: FloatArray
    lever_mm: FloatArray
    spread_mm: FloatArray


class FitRules(NamedTuple):
    """Rules of the fit of planes; see `speckle3d.motion.planes`.

    Attributes
    ----------
    sensed : bool
        Whether slopes are known from a sensor.
    slope_sd : float
        Standard deviation of the slopes' prior.
    """

    sensed: bool
    slope_sd: float
    widest_slope: float
    huber: float
    outlying: float
    crossing_evidence: float


class PairPatches(NamedTuple):
    """A pair's patches that take part, and the curves they are read with.

    Attributes
    ----------
    table : float64, shape (7, p)
    start : int64, shape (p,)
        Of each patch's curve in `amplitude`.
    amplitude : float64
        The curves one after the other.
    last : float
        Position in a curve up to which it is read.
    step_mm : float
    of_echo : bool
    """

    table: FloatArray
    start: IntArray
    amplitude: FloatArray
    last: float
    step_mm: float
    of_echo: bool


@register_jitable(fastmath=False, error_model="numpy")
def predict_correlation(
    distance_mm: float,
    amplitude: FloatArray,
    first: int,
    last: float,
    step_mm: float,
    share: float,
    gain: float,
    cells: float,
    of_echo: bool,
) -> tuple[float, float, float]:
    """Correlation of one patch at a distance, its derivative by distance, and its variance.

    Parameters
    ----------
    amplitude : float64
        sqrt(rho_F) on a grid, from `first` on; read up to the position `last` in it.
    step_mm : float
        Of the grid.
    share, gain : float
        Share of the amplitude that stays, and gain.
    """
    at = distance_mm / step_mm
    at = at if at < last else last
    k = int(at)
    low = amplitude[first + k]
    rise = amplitude[first + k + 1] - low
    g = low + (at - k) * rise
    field = share + (1.0 - share) * g
    model = gain * field * field
    derivative = 2.0 * gain * field * (1.0 - share) * (rise / step_mm)
    limited = model if model < 0.999 else 0.999
    return model, derivative, correlation_variance(limited, cells, of_echo) + INTERPOLATION**2


@register_jitable(fastmath=False, error_model="numpy")
def _distance(plane: FloatArray, i: int, patches: PairPatches) -> tuple[float, float, float]:
    """Distance of a patch without and with the decorrelation by rotation, and its part."""
    t = patches.table
    z = plane[0] + t[LATERAL, i] * plane[1] + t[_LEVER, i] * plane[2]
    turned = t[_SPREAD, i] * plane[2]
    return z, turned, np.sqrt(z * z + turned * turned)


@register_jitable(fastmath=False, error_model="numpy")
def _predict(d: float, i: int, patches: PairPatches) -> tuple[float, float, float]:
    """As `predict_correlation`, but one over the standard deviation."""
    t = patches.table
    model, derivative, variance = predict_correlation(
        d,
        patches.amplitude,
        patches.start[i],
        patches.last,
        patches.step_mm,
        t[_SHARE, i],
        t[_GAIN, i],
        t[_CELLS, i],
        patches.of_echo,
    )
    return model, derivative, 1.0 / np.sqrt(variance)


@register_jitable(fastmath=_FAST, error_model="numpy")
def _evaluate(plane: FloatArray, size: int, patches: PairPatches, rules: FitRules, sums: FloatArray) -> None:
    """Fill `sums`: robust cost, capped cost, half the falling gradient, half the Hessian's upper triangle."""
    huber, outlying, table = rules.huber, rules.outlying, patches.table
    cost, capped = 0.0, 0.0
    g0, g1, g2 = 0.0, 0.0, 0.0
    h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(size):
        z, turned, d = _distance(plane, i, patches)
        model, slope, certainty = _predict(d, i, patches)
        left = (table[_RHO, i] - model) * certainty
        misfit = abs(left)
        square = left * left
        inside = misfit <= huber
        weight = 1.0 if inside else huber / misfit
        cost += square if inside else huber * (2.0 * misfit - huber)
        capped += square if square < outlying else outlying
        factor = slope * certainty / (d if d > 1e-9 else 1e-9)
        j0 = factor * z
        j1 = j0 * table[LATERAL, i]
        j2 = j0 * table[_LEVER, i] + factor * table[_SPREAD, i] * turned
        w0, w1, w2 = weight * j0, weight * j1, weight * j2
        g0 += w0 * left
        g1 += w1 * left
        g2 += w2 * left
        h00 += w0 * j0
        h01 += w0 * j1
        h02 += w0 * j2
        h11 += w1 * j1
        h12 += w1 * j2
        h22 += w2 * j2
    sums[0], sums[1] = cost, capped
    sums[2], sums[3], sums[4] = g0, g1, g2
    sums[5], sums[6], sums[7], sums[8], sums[9], sums[10] = h00, h01, h02, h11, h12, h22


@register_jitable(fastmath=_FAST, error_model="numpy")
def _with_prior(plane: FloatArray, expected: FloatArray, precision: FloatArray, sums: FloatArray) -> None:
    """Add what the prior has to the sums of `_evaluate`."""
    for k in range(3):
        off = plane[k] - expected[k]
        sums[0] += precision[k] * off * off
        sums[2 + k] -= precision[k] * off
    sums[5] += precision[0]
    sums[8] += precision[1]
    sums[10] += precision[2]


@register_jitable(fastmath=_FAST, error_model="numpy")
def _solve(sums: FloatArray, damping: float, step: FloatArray) -> None:
    """Step of the damped normal equations, by their triangular factors."""
    d0 = sums[5] + damping * (sums[5] + 1e-9)
    l1, l2 = sums[6] / d0, sums[7] / d0
    d1 = sums[8] + damping * (sums[8] + 1e-9) - l1 * sums[6]
    m2 = sums[9] - l1 * sums[7]
    l12 = m2 / d1
    d2 = sums[10] + damping * (sums[10] + 1e-9) - l2 * sums[7] - l12 * m2
    y1 = sums[3] - l1 * sums[2]
    y2 = sums[4] - l2 * sums[2] - l12 * y1
    step[2] = y2 / d2
    step[1] = y1 / d1 - l12 * step[2]
    step[0] = sums[2] / d0 - l1 * step[1] - l2 * step[2]


@register_jitable(fastmath=_FAST, error_model="numpy")
def descend(
    plane: FloatArray,
    size: int,
    patches: PairPatches,
    expected: FloatArray,
    precision: FloatArray,
    rules: FitRules,
) -> tuple[float, float]:
    """Levenberg-Marquardt from `plane`, which it overwrites; returns the robust and the capped cost."""
    damping, least, capped = 1e-3, np.inf, np.inf
    trial, step, sums, best = plane.copy(), np.zeros(3), np.zeros(11), np.zeros(11)
    while damping < 1e9:
        _evaluate(trial, size, patches, rules, sums)
        _with_prior(trial, expected, precision, sums)
        total = sums[0]
        if total <= least:
            settled = least - total < 1e-6 * max(total, 1.0)
            least, capped = total, sums[1]
            for k in range(3):
                plane[k] = trial[k]
            for k in range(11):
                best[k] = sums[k]
            damping = max(damping * 0.2, 1e-9)
            if settled:
                break
        else:
            damping *= 8.0
        _solve(best, damping, step)
        for k in range(3):
            trial[k] = plane[k] + step[k]
    return least, capped


@register_jitable(fastmath=_FAST, error_model="numpy")
def add_information(
    plane: FloatArray, size: int, patches: PairPatches, rules: FitRules, information: FloatArray
) -> None:
    """Add the patches' information on the plane."""
    arm = np.ones(3)
    for i in range(size):
        z, _, d = _distance(plane, i, patches)
        model, _, certainty = _predict(d, i, patches)
        # Near no distance the correlation is flat; its curvature still tells one that is not small.
        off = d if d > _LEAST_MM else _LEAST_MM
        _, steep, _ = _predict(off, i, patches)
        misfit = abs((patches.table[_RHO, i] - model) * certainty)
        weight = 1.0 if misfit <= rules.huber else rules.huber / misfit
        told = steep * certainty * max(abs(z), _LEAST_MM) / off
        arm[1], arm[2] = patches.table[LATERAL, i], patches.table[_LEVER, i]
        for k in range(3):
            for j in range(3):
                information[k, j] += weight * told * told * arm[k] * arm[j]


@register_jitable(fastmath=_FAST, error_model="numpy")
def gather(
    e: int,
    rho: Float32Array,
    used: BoolArray,
    moved_mm: FloatArray,
    models: EchoModels,
    levers: Levers,
    curves: PatchCurves,
    patches: PairPatches,
) -> int:
    """Fill in the patches of pair `e` that take part; returns how many they are."""
    table = patches.table
    row = e if models.share.shape[0] > 1 else 0
    size = 0
    for p in range(used.shape[1]):
        if not used[e, p]:
            continue
        patches.start[size] = p * curves.amplitude.shape[1]
        table[_RHO, size] = rho[e, p]
        table[LATERAL, size] = levers.lateral_mm[p] - moved_mm[e, 0]
        table[_LEVER, size] = levers.lever_mm[p] - moved_mm[e, 1]
        table[_SPREAD, size] = levers.spread_mm[p]
        table[_SHARE, size] = models.share[row, p]
        table[_GAIN, size] = models.gain[row, p]
        table[_CELLS, size] = curves.cells[p]
        size += 1
    return size
