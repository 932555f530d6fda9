"""Fitting the plane of one frame pair to the correlations of its patches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.statistics import INTERPOLATION, PatchCurves, correlation_variance

_variance = njit(correlation_variance)

_LEAST_MM = 0.05
"""Distance below which correlation is flat: sensitivities are not taken to be less than here."""


class PlaneFit(NamedTuple):
    """Start and result of `fit_correlation_plane`, filled by it.

    Attributes
    ----------
    plane : float64, shape (3,)
        Offset and slopes: the start, overwritten with the result.
    information : float64, shape (3, 3)
    standard, sensitivity : float64, shape (p,)
        Each patch's residual over its standard deviation, NaN where it takes no part, and the change of that
        with distance, per mm.
    """

    plane: FloatArray
    information: FloatArray
    standard: FloatArray
    sensitivity: FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def predict_correlation(
    distance_mm: float,
    amplitude: FloatArray,
    step_mm: float,
    echo: FloatArray,
    cells: float,
    of_echo: bool,
) -> tuple[float, float, float]:
    """Correlation of one patch at a distance, its derivative by distance, and its variance.

    Parameters
    ----------
    amplitude : float64, shape (m,)
        sqrt(rho_F) on a grid of `step_mm`.
    echo : float64, shape (6,)
        Staying and moving share of the amplitude, gain, stretch, and the standard deviations of the staying
        share and of the stretch, the latter relative.
    """
    staying, moving, gain, stretch, staying_sd, stretch_sd = echo
    at = min(distance_mm / stretch / step_mm, amplitude.size - 1.001)
    k = int(at)
    rise = amplitude[k + 1] - amplitude[k]
    g = amplitude[k] + (at - k) * rise
    slope = rise / step_mm / stretch
    field = staying + moving * g
    model = gain * field * field
    derivative = 2.0 * gain * field * moving * slope
    limited = min(model, 0.999)
    noise = _variance(limited, cells, of_echo) + INTERPOLATION**2
    share_error = staying_sd * (1.0 - g) * 2.0 * field * gain
    stretch_error = stretch_sd * derivative * distance_mm
    return model, derivative, noise + share_error * share_error + stretch_error * stretch_error


@njit(cache=True, nogil=True, error_model="numpy")
def fit_correlation_plane(
    rho: FloatArray,
    design: FloatArray,
    spread_mm: FloatArray,
    echo: FloatArray,
    curves: PatchCurves,
    prior: FloatArray,
    huber: float,
    rounds: int,
    fit: PlaneFit,
) -> float:
    """Fit by Levenberg-Marquardt to the correlations; returns the robust cost.

    Parameters
    ----------
    rho : float64, shape (p,)
        NaN where a patch takes no part.
    design : float64, shape (p, 3)
        What offset and slopes are multiplied by: their sum is each patch's signed distance.
    spread_mm : float64, shape (p,)
        Times the last coefficient, the tilt, and in quadrature with the distance: what turning alone
        decorrelates.
    echo : float64, shape (p, 6)
        As for `predict_correlation`.
    curves : PatchCurves
    prior : float64, shape (2, 3)
        What the coefficients are expected to be, and one over the variance about it.
    fit : PlaneFit
        Holds the start, and receives the result.
    """
    amplitude, step_mm, cells, of_echo = curves
    plane, normal, standard, sensitivity = fit
    expected, precision = prior
    patches = rho.size
    damping, last = 1e-3, np.inf
    trial = plane.copy()
    gradient = np.zeros(3)
    step = np.zeros(3)
    hessian = np.zeros((3, 3))
    inner, outer = np.zeros(3), np.zeros(3)
    new_standard, new_sensitivity = np.empty(patches), np.zeros(patches)
    for _ in range(rounds + 1):
        total = 0.0
        new_gradient = np.zeros(3)
        new_hessian = np.zeros((3, 3))
        information = np.zeros((3, 3))
        for i in range(3):
            off = trial[i] - expected[i]
            total += precision[i] * off * off
            new_gradient[i] -= precision[i] * off
            new_hessian[i, i] += precision[i]
            information[i, i] += precision[i]
        for p in range(patches):
            new_standard[p] = np.nan
            if not np.isfinite(rho[p]):
                continue
            z = design[p, 0] * trial[0] + design[p, 1] * trial[1] + design[p, 2] * trial[2]
            turned = spread_mm[p] * trial[2]
            d = np.sqrt(z * z + turned * turned)
            model, slope, variance = predict_correlation(d, amplitude[p], step_mm, echo[p], cells[p], of_echo)
            sigma = np.sqrt(variance)
            left = (rho[p] - model) / sigma
            new_standard[p] = left
            size = abs(left)
            weight = 1.0 if size <= huber else huber / size
            total += left * left if size <= huber else huber * (2.0 * size - huber)
            # Near no distance the correlation is flat; its curvature still tells one that is not small.
            _, steep, _ = predict_correlation(
                max(d, _LEAST_MM), amplitude[p], step_mm, echo[p], cells[p], of_echo
            )
            side = 1.0 if z >= 0.0 else -1.0
            new_sensitivity[p] = -steep / sigma
            for i in range(3):
                change = z * design[p, i] + (spread_mm[p] * turned if i == 2 else 0.0)
                inner[i] = slope * change / max(d, 1e-9) / sigma
                outer[i] = steep * (design[p, i] * side * max(abs(z), _LEAST_MM)) / max(d, _LEAST_MM) / sigma
            for i in range(3):
                new_gradient[i] += weight * inner[i] * left
                for j in range(3):
                    new_hessian[i, j] += weight * inner[i] * inner[j]
                    information[i, j] += weight * outer[i] * outer[j]
        if total <= last:
            settled = last - total < 1e-6 * max(total, 1.0)
            last = total
            plane[:] = trial
            normal[:] = information
            gradient[:] = new_gradient
            hessian[:] = new_hessian
            standard[:] = new_standard
            sensitivity[:] = new_sensitivity
            damping = max(damping * 0.2, 1e-9)
            if settled:
                break
        else:
            damping *= 8.0
        damped = hessian.copy()
        for i in range(3):
            damped[i, i] += damping * (hessian[i, i] + 1e-9)
        step[:] = np.linalg.solve(damped, gradient)
        trial = plane + step
    return last
