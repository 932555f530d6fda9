"""Fitting each patch's coherent share and gain to its correlations at many separations."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

_ROUNDS = 7
_VARIANCE_FLOOR = 1e-3
"""Variance of a correlation that no number of cells removes: what the model itself leaves out."""


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "arcp"})
def fit_coherent_shares(
    rho: Float32Array,
    distance_mm: FloatArray,
    scales: FloatArray,
    amplitude: FloatArray,
    step_mm: float,
    cells: FloatArray,
    structure_mm: float,
    redundancy: float,
    gain_precision: float,
    out: FloatArray,
) -> None:
    """Fit rho = gain (c h + (1 - c) g)^2 of each patch at each scale of the distances.

    g is the square root of the fully developed curve, h = exp(-d / structure_mm).

    Parameters
    ----------
    rho : float32, shape (e, p)
        NaN where there is none.
    distance_mm : float64, shape (e,)
    scales : float64, shape (s,)
        What distances are multiplied by in turn.
    amplitude : float64, shape (p, k)
        g on a grid of `step_mm`.
    cells : float64, shape (p,)
    redundancy : float
        How many of the pairs, which share frames, carry one independent piece of information.
    gain_precision : float
        Of the prior about gain one.
    out : float64, shape (s, p, 6)
        Share, gain and cost of the fit; gain and cost with no coherent share; cost with neither.
    """
    pairs, patches = rho.shape
    last = amplitude.shape[1] - 1
    g = np.empty(pairs)
    h = np.empty(pairs)
    for s in range(scales.size):
        for p in range(patches):
            for e in range(pairs):
                d = distance_mm[e] * scales[s]
                at = min(d / step_mm, last - 1e-6)
                k = int(at)
                g[e] = amplitude[p, k] + (at - k) * (amplitude[p, k + 1] - amplitude[p, k])
                h[e] = np.exp(-d / structure_mm)
            for with_share in range(2):
                c = 0.1 if with_share else 0.0
                gain = 1.0
                cost = 0.0
                for turn in range(_ROUNDS):
                    cc, cg, gg, rc, rg = 0.1, 0.0, 0.0, 0.0, 0.0
                    cost = 0.0
                    for e in range(pairs):
                        r = rho[e, p]
                        if not np.isfinite(r):
                            continue
                        q = c * h[e] + (1.0 - c) * g[e]
                        m = gain * q * q
                        limited = min(m, 1.0)
                        v = (1.0 - limited * limited) ** 2 / cells[p] + _VARIANCE_FLOOR
                        left = r - m
                        jc = 2.0 * gain * q * (h[e] - g[e])
                        jg = q * q
                        w = 1.0 / (v * redundancy)
                        cc += w * jc * jc
                        cg += w * jc * jg
                        gg += w * jg * jg
                        rc += w * jc * left
                        rg += w * jg * left
                        if turn in (0, _ROUNDS - 1):
                            cost += (left * left / v + np.log(v)) / redundancy
                    gg += gain_precision
                    rg -= gain_precision * (gain - 1.0)
                    cost += gain_precision * (gain - 1.0) ** 2
                    if turn == 0 and not with_share:
                        out[s, p, 5] = cost
                    if with_share:
                        determinant = cc * gg - cg * cg
                        c = min(max(c + 0.8 * (gg * rc - cg * rg) / determinant, 0.0), 0.97)
                        gain = min(max(gain + 0.8 * (cc * rg - cg * rc) / determinant, 0.1), 1.03)
                    else:
                        gain = min(max(gain + rg / gg, 0.1), 1.03)
                if with_share:
                    out[s, p, 0], out[s, p, 1], out[s, p, 2] = c, gain, cost
                else:
                    out[s, p, 3], out[s, p, 4] = gain, cost
