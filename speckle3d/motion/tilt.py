"""Tilt: what it does to decorrelation, learnt on phantom frames that turn.

References
----------
.. [1] Housden et al., "Rotational motion in sensorless freehand three-dimensional ultrasound",
   Ultrasonics 48(5), 2008: out-of-plane rotation decorrelates speckle, too.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from speckle3d.core.arrays import FloatArray
from speckle3d.core.curves import TiltResponse
from speckle3d.kernels.statistics import correlation_variance

PAIRS_PER_FACT = 20.0
"""Frame pairs per independent piece of information: pairs share frames."""
SURE_MM = 4.0
"""Standard deviation below which a pivot counts as learnt, a fraction of the probe's focal length."""
TURNED_RAD = 1e-5


def effective_distance(
    offset_mm: FloatArray, tilt_rad: FloatArray, pivot_mm: FloatArray | float, spread_mm: FloatArray | float
) -> FloatArray:
    """Distance without tilt at which speckle would have decorrelated as much."""
    return np.asarray(np.hypot(offset_mm - pivot_mm * tilt_rad, spread_mm * tilt_rad))


def fit_tilt_response(
    depths_mm: FloatArray,
    curves: FloatArray,
    cells: FloatArray,
    distance_mm: FloatArray,
    wavenumber_per_mm: float,
    of_echo: bool,
    samples: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
) -> TiltResponse | None:
    """Fit the pivot at each depth to phantom frames that turned; None if they hardly did.

    The spread cannot be told from the pivot as long as frames turn about the probe's face. It is what
    a Gaussian beam of the curves' own width has, two-way wavenumber times width squared.

    Parameters
    ----------
    depths_mm, cells : ndarray, shape (r,)
    curves : ndarray, shape (r, k)
        On `distance_mm`, shape (k,).
    wavenumber_per_mm : float
        Two-way, 4 pi over the wavelength; 0 if it is not known.
    samples : tuple of ndarray, each of shape (n,)
        Depth, signed offset, tilt, correlation.
    """
    depth, offset, tilt, rho = samples
    turned = np.isfinite(rho) & (np.abs(tilt) > TURNED_RAD) & (np.abs(offset) < distance_mm[-1])
    width = np.array([np.interp(0.5, -np.log(curve), distance_mm) for curve in curves])
    spread = wavenumber_per_mm * width**2
    fits = []
    for number, row in enumerate(depths_mm):
        here = turned & (np.abs(depth - row) < 1e-5)
        if here.sum() < 4 * PAIRS_PER_FACT:
            return None
        seen = offset[here], tilt[here], rho[here]
        fits.append(_fit_pivot(*seen, distance_mm, curves[number], cells[number], spread[number], of_echo))
    pivot, deviation = np.array(fits).T
    if np.median(deviation) > SURE_MM:
        return None
    # Wavefronts change slowly with depth.
    smooth = np.polynomial.Polynomial.fit(depths_mm, pivot, min(2, depths_mm.size - 1), w=1 / deviation)
    return TiltResponse(smooth(depths_mm), spread)


def _fit_pivot(
    offset: FloatArray,
    tilt: FloatArray,
    rho: FloatArray,
    distance_mm: FloatArray,
    curve: FloatArray,
    cells: float,
    spread: float,
    of_echo: bool,
) -> tuple[float, float]:
    """Pivot of one depth and its standard deviation."""

    def standard(pivot: FloatArray) -> FloatArray:
        expected = np.interp(effective_distance(offset, tilt, pivot[0], spread), distance_mm, curve)
        variance = correlation_variance(np.minimum(expected, 0.98), cells / PAIRS_PER_FACT, of_echo)
        return np.asarray((rho - expected) / np.sqrt(variance))

    starts = [least_squares(standard, [start], loss="soft_l1") for start in (-8.0, 0.0, 8.0)]
    fit = min(starts, key=lambda f: float(f.cost))
    return float(fit.x[0]), float(1 / np.sqrt(np.square(np.asarray(fit.jac)).sum() + 1e-9))
