"""Fitting echo models to each patch's correlations at many separations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import float64, int64, njit
from numba.extending import intrinsic

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


def _as_integer(typing: Any, number: Any) -> Any:
    return int64(float64), lambda context, builder, signature, args: builder.bitcast(args[0], ir.IntType(64))


def _as_number(typing: Any, bits: Any) -> Any:
    return float64(int64), lambda context, builder, signature, args: builder.bitcast(args[0], ir.DoubleType())


_bits: Callable[[float], int] = cast(Any, intrinsic(_as_integer))
"""A float64 as the integer of the same bits."""
_number: Callable[[int], float] = cast(Any, intrinsic(_as_number))
"""The float64 of an integer's bits."""


@njit(cache=True, nogil=True, fastmath=False)
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
            # NumPy's search is as quick, but takes half a second to compile.
            low, high = 0, edges_mm.size
            while low < high:
                middle = (low + high) // 2
                if edges_mm[middle] > d:
                    high = middle
                else:
                    low = middle + 1
            b = min(low - 1, last)
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
    weight, distance, mean, spread = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
    g, h = np.empty(room), np.empty((lengths_mm.size, room))
    for e in range(first, stop):
        p = e % cells.size
        size = 0
        for b in range(bins.shape[1]):
            n = bins[e, b, 0]
            if n > 0:
                weight[size] = n / redundancy
                distance[size] = bins[e, b, 1] / n
                mean[size] = bins[e, b, 2] / n
                spread[size] = bins[e, b, 3] / n - mean[size] ** 2
                size += 1
        while size % _LANES:
            weight[size] = distance[size] = mean[size] = spread[size] = 0.0
            size += 1
        for s in range(scales.size):
            for j in range(lengths_mm.size):
                for b in range(size):
                    h[j, b] = 0.0
                    if lengths_mm[j] > 0.0:
                        h[j, b] = _exponential(max(-distance[b] * (scales[s] / lengths_mm[j]), -700.0))
            for k in range(stretches.size):
                ratio = scales[s] / stretches[k] / step_mm
                for b in range(size):
                    at = min(distance[b] * ratio, last - 1e-6)
                    q = int(at)
                    g[b] = amplitude[p, q] + (at - q) * (amplitude[p, q + 1] - amplitude[p, q])
                for j in range(lengths_mm.size):
                    share, gain, new_share, new_gain = 0.0, 1.0, 0.0, 1.0
                    if lengths_mm[j] > 0.0:
                        share, gain, new_share, new_gain = _fit_both(
                            weight, mean, g, h, j, cells[p], of_echo, gain_precision, size
                        )
                    elif lengths_mm[j] != NO_GAIN:
                        gain, new_gain = _fit_gain(weight, mean, g, cells[p], of_echo, gain_precision, size)
                    cost[e, s, k, j] = gain_precision * (gain - 1.0) ** 2 + _misfit(
                        weight, mean, spread, g, h, j, share, gain, cells[p], of_echo, size
                    )
                    found[e, s, k, j, 0], found[e, s, k, j, 1] = new_share, new_gain


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _fit_both(
    weight: FloatArray,
    mean: FloatArray,
    g: FloatArray,
    h: FloatArray,
    j: int,
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
            apart = h[j, b] - g[b]
            echo = g[b] + share * apart
            jg = echo * echo
            model = gain * jg
            w = weight[b] / (_variance(min(model, 1.0), cells, of_echo) + _VARIANCE_FLOOR)
            left = mean[b] - model
            jc = 2.0 * gain * echo * apart
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


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
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


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _misfit(
    weight: FloatArray,
    mean: FloatArray,
    spread: FloatArray,
    g: FloatArray,
    h: FloatArray,
    j: int,
    share: float,
    gain: float,
    cells: float,
    of_echo: bool,
    size: int,
) -> float:
    """Twice the negative log-likelihood."""
    total = 0.0
    for b in range(size):
        echo = g[b] + share * (h[j, b] - g[b])
        model = gain * echo * echo
        left = mean[b] - model
        v = _variance(min(model, 1.0), cells, of_echo) + _VARIANCE_FLOOR
        total += weight[b] * ((left * left + spread[b]) / v + _logarithm(v))
    return total


# Logarithm and exponential without a call: the processor can take them of many bins at once.


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _logarithm(x: float) -> float:
    """Of a number above zero, by 2 artanh((m - 1) / (m + 1)) of its mantissa."""
    bits = _bits(x)
    power = (bits - _ROOT_HALF_BITS) >> _EXPONENT
    m = _number(bits - (power << _EXPONENT))
    t = (m - 1.0) / (m + 1.0)
    q = t * t
    series = 1 / 11 + q * (1 / 13 + q * (1 / 15 + q * (1 / 17 + q / 19)))
    series = 1.0 + q * (1 / 3 + q * (1 / 5 + q * (1 / 7 + q * (1 / 9 + q * series))))
    return float(power * _LN2 + 2.0 * t * series)


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _exponential(x: float) -> float:
    """Of a number from -700 to 0, by the series for what powers of two leave."""
    power = np.floor(x / _LN2 + 0.5)
    r = x - power * _LN2_HIGH - power * _LN2_LOW
    series = 1.0
    for term in (12.0, 11.0, 10.0, 9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0):
        series = 1.0 + series * r / term
    return float(_number(_bits(series) + (int(power) << _EXPONENT)))
