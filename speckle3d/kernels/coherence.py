"""Fitting echo models to each patch's correlations at many separations."""

from __future__ import annotations

import numpy as np
from numba import njit

from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.kernels.statistics import PatchCurves, correlation_variance

_variance = njit(correlation_variance)

NO_GAIN = -1.0
"""In place of a length of coherent structure: neither structure nor noise, so that the gain is one."""
_ROUNDS = 8
_SETTLED = 2e-3
_VARIANCE_FLOOR = 1e-3
"""Variance of a correlation that no number of cells removes: what the model itself leaves out."""


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


@njit(cache=True, nogil=True, error_model="numpy")
def fit_echo_models(
    bins: FloatArray,
    scales: FloatArray,
    stretches: FloatArray,
    lengths_mm: FloatArray,
    curves: PatchCurves,
    redundancy: float,
    gain_precision: float,
    cost: FloatArray,
    found: FloatArray,
) -> None:
    """Fit rho = gain (c h + (1 - c) g)^2 of each patch, for each scale of distances and kind of model.

    g(d) is the square root of the fully developed curve at d / stretch, h = exp(-d / length).

    Parameters
    ----------
    bins : float64, shape (p, b, 4)
        From `bin_by_distance`.
    scales : float64, shape (s,)
        What distances are multiplied by in turn.
    stretches : float64, shape (k,)
    lengths_mm : float64, shape (l,)
        Of coherent structure; 0 for models without any, where c = 0; `NO_GAIN` for those with gain one, too.
    curves : PatchCurves
    redundancy : float
        How many of the pairs, which share frames, carry one independent piece of information.
    gain_precision : float
        Of the prior about gain one.
    cost : float64, shape (s, p, k, l)
        Twice the negative log-likelihood.
    found : float64, shape (s, p, k, l, 2)
        Share and gain.
    """
    amplitude, step_mm, cells, of_echo = curves
    count = bins.shape[1]
    last = amplitude.shape[1] - 1
    g, h = np.empty(count), np.empty(count)
    n, d0, mean, spread = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for p in range(bins.shape[0]):
        size = 0
        for b in range(count):
            if bins[p, b, 0] > 0:
                n[size] = bins[p, b, 0]
                d0[size] = bins[p, b, 1] / n[size]
                mean[size] = bins[p, b, 2] / n[size]
                spread[size] = bins[p, b, 3] / n[size] - mean[size] ** 2
                size += 1
        for s in range(scales.size):
            for k in range(stretches.size):
                for b in range(size):
                    at = min(d0[b] * scales[s] / stretches[k] / step_mm, last - 1e-6)
                    q = int(at)
                    g[b] = amplitude[p, q] + (at - q) * (amplitude[p, q + 1] - amplitude[p, q])
                for j in range(lengths_mm.size):
                    coherent = lengths_mm[j] > 0.0
                    for b in range(size):
                        h[b] = np.exp(-d0[b] * scales[s] / lengths_mm[j]) if coherent else 0.0
                    share = 0.1 if coherent else 0.0
                    gain, total = 1.0, 0.0
                    for _ in range(_ROUNDS):
                        cc, cg, gg, rc, rg, total = 0.1, 0.0, 0.0, 0.0, 0.0, 0.0
                        for b in range(size):
                            echo = share * h[b] + (1.0 - share) * g[b]
                            model = gain * echo * echo
                            limited = min(model, 1.0)
                            v = _variance(limited, cells[p], of_echo) + _VARIANCE_FLOOR
                            left = mean[b] - model
                            w = n[b] / (v * redundancy)
                            jc = 2.0 * gain * echo * (h[b] - g[b])
                            jg = echo * echo
                            cc += w * jc * jc
                            cg += w * jc * jg
                            gg += w * jg * jg
                            rc += w * jc * left
                            rg += w * jg * left
                            total += w * (left * left + spread[b]) + n[b] * np.log(v) / redundancy
                        if lengths_mm[j] == NO_GAIN:
                            break
                        total += gain_precision * (gain - 1.0) ** 2
                        gg += gain_precision
                        rg -= gain_precision * (gain - 1.0)
                        if not coherent:
                            cc, cg, rc = 1.0, 0.0, 0.0
                        determinant = cc * gg - cg * cg
                        new_share = min(max(share + 0.8 * (gg * rc - cg * rg) / determinant, 0.0), 0.97)
                        new_gain = min(max(gain + 0.8 * (cc * rg - cg * rc) / determinant, 0.1), 1.03)
                        if abs(new_share - share) + abs(new_gain - gain) < _SETTLED:
                            break
                        share, gain = new_share, new_gain
                    cost[s, p, k, j] = total
                    found[s, p, k, j, 0], found[s, p, k, j, 1] = share, gain
