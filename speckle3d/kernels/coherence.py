"""Fitting echo models to each patch's correlations at many separations."""

from __future__ import annotations

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.kernels.statistics import PatchCurves, correlation_variance

_FAST = {"reassoc", "contract", "arcp"}
_variance = njit(fastmath=_FAST)(correlation_variance)

NO_GAIN = -1.0
"""In place of a length of coherent structure: neither structure nor noise, so that the gain is one."""
_ROUNDS = 8
_SETTLED = 2e-3
_VARIANCE_FLOOR = 1e-3
"""Variance of a correlation that no number of cells removes: what the model itself leaves out."""
_LANES = 8
"""Bins are filled up to a multiple of this with empty ones, which the processor adds at once."""
_LN2, _LN2_HIGH, _LN2_LOW = 0.6931471805599453, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_ROOT_HALF_BITS, _EXPONENT = 0x3FE6A09E667F3BCD, 52
"""Square root of a half as an integer, and where the exponent of a float64 begins."""


@njit(cache=True, nogil=True)
def bin_by_distance(
    rho: Float32Array,
    offset_mm: FloatArray,
    slope: FloatArray,
    lateral_mm: FloatArray,
    edges_mm: FloatArray,
    out: FloatArray,
) -> None:
    """Sum correlations of each patch over pairs of like distance |offset + slope lateral|.

    Parameters
    ----------
    rho : float32, shape (e, p)
        NaN where there is none.
    offset_mm, slope : float64, shape (e,)
    lateral_mm : float64, shape (p,)
    edges_mm : float64, shape (b + 1,)
        Distances beyond the last count into the last bin.
    out : float64, shape (p, b, 4)
        Count, and sums of distance, correlation and its square.
    """
    out[:] = 0.0
    last = edges_mm.size - 2
    for e in range(rho.shape[0]):
        for p in range(rho.shape[1]):
            r = rho[e, p]
            if not np.isfinite(r):
                continue
            d = abs(offset_mm[e] + slope[e] * lateral_mm[p])
            b = min(np.searchsorted(edges_mm, d, side="right") - 1, last)
            out[p, b, 0] += 1.0
            out[p, b, 1] += d
            out[p, b, 2] += r
            out[p, b, 3] += r * r


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def fit_echo_models(
    bins: FloatArray,
    scales: FloatArray,
    stretches: FloatArray,
    lengths_mm: FloatArray,
    curves: PatchCurves,
    redundancy: float,
    gain_precision: float,
    first: int,
    stop: int,
    cost: FloatArray,
    found: FloatArray,
) -> None:
    """Fit rho = gain (c h + (1 - c) g)^2 of each patch, for each scale of distances and kind of model.

    g(d) is the square root of the fully developed curve at d / stretch, h = exp(-d / length).

    Parameters
    ----------
    bins : float64, shape (e, b, 4)
        From `bin_by_distance`; e is a multiple of the patches, which follow each other again and again.
    scales : float64, shape (s,)
        What distances are multiplied by in turn.
    stretches : float64, shape (k,)
    lengths_mm : float64, shape (l,)
        Of coherent structure; 0 for models without any, where c = 0; `NO_GAIN` for those with gain one, too.
    curves : PatchCurves
        Of p patches.
    redundancy : float
        How many of the pairs, which share frames, carry one independent piece of information.
    gain_precision : float
        Of the prior about gain one.
    first, stop : int
        Which of the e are fitted.
    cost : float64, shape (e, s, k, l)
        Twice the negative log-likelihood.
    found : float64, shape (e, s, k, l, 2)
        Share and gain.
    """
    amplitude, step_mm, cells, of_echo = curves
    last = amplitude.shape[1] - 1
    room = (bins.shape[1] + _LANES - 1) // _LANES * _LANES
    table, g, v, h = np.empty((4, room)), np.empty(room), np.empty(room), np.empty((lengths_mm.size, room))
    for e in range(first, stop):
        p = e % cells.size
        size = _fill(bins[e], redundancy, table)
        for s in range(scales.size):
            for j in range(lengths_mm.size):
                if lengths_mm[j] > 0.0:
                    _decay(table[1], scales[s] / lengths_mm[j], size, h[j])
                else:
                    h[j] = 0.0
            for k in range(stretches.size):
                ratio = scales[s] / stretches[k] / step_mm
                for b in range(size):
                    at = min(table[1, b] * ratio, last - 1e-6)
                    q = int(at)
                    g[b] = amplitude[p, q] + (at - q) * (amplitude[p, q + 1] - amplitude[p, q])
                for j in range(lengths_mm.size):
                    share, gain, new_share, new_gain, prior = 0.0, 1.0, 0.0, 1.0, 0.0
                    if lengths_mm[j] > 0.0:
                        share, gain, new_share, new_gain = _fit_both(
                            table[0], table[2], g, h[j], cells[p], of_echo, gain_precision, size
                        )
                    elif lengths_mm[j] != NO_GAIN:
                        gain, new_gain = _fit_gain(
                            table[0], table[2], g, cells[p], of_echo, gain_precision, size
                        )
                    prior = gain_precision * (gain - 1.0) ** 2
                    cost[e, s, k, j] = prior + _misfit(
                        table, g, h[j], share, gain, cells[p], of_echo, size, v
                    )
                    found[e, s, k, j, 0], found[e, s, k, j, 1] = new_share, new_gain


@njit(fastmath=_FAST, error_model="numpy")
def _fill(bins: FloatArray, redundancy: float, table: FloatArray) -> int:
    """Weight, distance, mean correlation and its variance of the bins that hold pairs; returns how many.

    Their number is rounded up to whole lanes by bins without any weight.
    """
    size = 0
    for b in range(bins.shape[0]):
        n = bins[b, 0]
        if n > 0:
            table[0, size] = n / redundancy
            table[1, size] = bins[b, 1] / n
            table[2, size] = bins[b, 2] / n
            table[3, size] = bins[b, 3] / n - table[2, size] ** 2
            size += 1
    whole = (size + _LANES - 1) // _LANES * _LANES
    table[:, size:whole] = 0.0
    return whole


@njit(fastmath=_FAST, error_model="numpy")
def _fit_both(
    weight: FloatArray,
    mean: FloatArray,
    g: FloatArray,
    h: FloatArray,
    cells: float,
    of_echo: bool,
    gain_precision: float,
    size: int,
) -> tuple[float, float, float, float]:
    """Share and gain by damped Gauss-Newton: those of the last round, and those after it."""
    share, gain = 0.1, 1.0
    for turn in range(_ROUNDS):
        cc, cg, gg, rc, rg = 0.1, 0.0, gain_precision, 0.0, -gain_precision * (gain - 1.0)
        for b in range(size):
            echo = share * h[b] + (1.0 - share) * g[b]
            model = gain * echo * echo
            w = weight[b] / (_variance(min(model, 1.0), cells, of_echo) + _VARIANCE_FLOOR)
            left = mean[b] - model
            jc = 2.0 * gain * echo * (h[b] - g[b])
            jg = echo * echo
            cc += w * jc * jc
            cg += w * jc * jg
            gg += w * jg * jg
            rc += w * jc * left
            rg += w * jg * left
        determinant = cc * gg - cg * cg
        new_share = min(max(share + 0.8 * (gg * rc - cg * rg) / determinant, 0.0), 0.97)
        new_gain = min(max(gain + 0.8 * (cc * rg - cg * rc) / determinant, 0.1), 1.03)
        if abs(new_share - share) + abs(new_gain - gain) < _SETTLED:
            break
        if turn == _ROUNDS - 1:
            return share, gain, new_share, new_gain
        share, gain = new_share, new_gain
    return share, gain, share, gain


@njit(fastmath=_FAST, error_model="numpy")
def _fit_gain(
    weight: FloatArray,
    mean: FloatArray,
    g: FloatArray,
    cells: float,
    of_echo: bool,
    gain_precision: float,
    size: int,
) -> tuple[float, float]:
    """Gain alone, as `_fit_both` with no share."""
    gain = 1.0
    for turn in range(_ROUNDS):
        gg, rg = gain_precision, -gain_precision * (gain - 1.0)
        for b in range(size):
            jg = g[b] * g[b]
            model = gain * jg
            w = weight[b] / (_variance(min(model, 1.0), cells, of_echo) + _VARIANCE_FLOOR)
            gg += w * jg * jg
            rg += w * jg * (mean[b] - model)
        new_gain = min(max(gain + 0.8 * rg / gg, 0.1), 1.03)
        if abs(new_gain - gain) < _SETTLED:
            break
        if turn == _ROUNDS - 1:
            return gain, new_gain
        gain = new_gain
    return gain, gain


@njit(fastmath=_FAST, error_model="numpy")
def _misfit(
    table: FloatArray,
    g: FloatArray,
    h: FloatArray,
    share: float,
    gain: float,
    cells: float,
    of_echo: bool,
    size: int,
    v: FloatArray,
) -> float:
    """Twice the negative log-likelihood; `v` is room to work in."""
    total = 0.0
    for b in range(size):
        echo = share * h[b] + (1.0 - share) * g[b]
        model = gain * echo * echo
        left = table[2, b] - model
        v[b] = _variance(min(model, 1.0), cells, of_echo) + _VARIANCE_FLOOR
        total += table[0, b] / v[b] * (left * left + table[3, b])
    # A logarithm without a call can be taken of many bins at once: 2 artanh((m - 1) / (m + 1)).
    bits = v.view(np.int64)
    for b in range(size):
        power = (bits[b] - _ROOT_HALF_BITS) >> _EXPONENT
        bits[b] -= power << _EXPONENT
        t = (v[b] - 1.0) / (v[b] + 1.0)
        q = t * t
        series = 1 / 11 + q * (1 / 13 + q * (1 / 15 + q * (1 / 17 + q / 19)))
        series = 1.0 + q * (1 / 3 + q * (1 / 5 + q * (1 / 7 + q * (1 / 9 + q * series))))
        total += table[0, b] * (power * _LN2 + 2.0 * t * series)
    return total


@njit(fastmath=_FAST, error_model="numpy")
def _decay(distance: FloatArray, rate: float, size: int, out: FloatArray) -> None:
    """Fill `out` with exp(-rate distance) for what is not below zero, without a call, as `_misfit`."""
    bits = out.view(np.int64)
    for b in range(size):
        x = -min(distance[b] * rate, 700.0)
        power = np.floor(x / _LN2 + 0.5)
        r = x - power * _LN2_HIGH - power * _LN2_LOW
        series = 1.0
        for term in (12.0, 11.0, 10.0, 9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0):
            series = 1.0 + series * r / term
        out[b] = series
        bits[b] += np.int64(power) << _EXPONENT
