"""Fitting the planes of frame pairs to the correlations of their patches."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray
from speckle3d.kernels.plane_misfit import (
    LATERAL,
    EchoModels,
    FitRules,
    Levers,
    PairPatches,
    add_information,
    descend,
    gather,
)
from speckle3d.kernels.statistics import PatchCurves

_FAST = {"reassoc"}
_STARTS = 4


class FittedPlanes(NamedTuple):
    """Results of `fit_planes`, filled by it.

    Attributes
    ----------
    coefficients : float64, shape (e, 3)
        Offset and slopes.
    information : float64, shape (e, 3, 3)
        Inverse of their covariance.
    cost : float64, shape (e,)
        The robust cost.
    """

    coefficients: FloatArray
    information: FloatArray
    cost: FloatArray


@register_jitable(fastmath=False, error_model="numpy")
def _list_starts(
    middle_mm: float,
    slopes: FloatArray,
    either_side: bool,
    size: int,
    lateral: FloatArray,
    rules: FitRules,
    starts: FloatArray,
) -> int:
    """Fill the planes that fits start from: all patches on one side, then frames that cross in the image."""
    starts[0, 0], starts[0, 1], starts[0, 2] = middle_mm, slopes[0], slopes[1]
    if rules.sensed:
        starts[1, 0], starts[1, 1], starts[1, 2] = -middle_mm, slopes[0], slopes[1]
        return 2 if either_side else 1
    low, high, total = np.inf, -np.inf, 0.0
    for i in range(size):
        low, high, total = min(low, lateral[i]), max(high, lateral[i]), total + lateral[i]
    half, mean = (high - low) / 2.0, total / size
    if not (half > 0.0 and middle_mm < rules.widest_slope * half):
        return 1
    # V-shaped distances, which no plane on one side explains, fall towards the crossing.
    for k in range(3):
        centre = mean + 0.5 * (k - 1) * half
        total = 0.0
        for i in range(size):
            total += abs(lateral[i] - centre)
        slope = middle_mm * size / total
        starts[k + 1, 0], starts[k + 1, 1], starts[k + 1, 2] = -slope * centre, slope, 0.0
    return _STARTS


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def fit_planes(
    rho: Float32Array,
    used: BoolArray,
    moved_mm: FloatArray,
    models: EchoModels,
    levers: Levers,
    curves: PatchCurves,
    middle_mm: FloatArray,
    slopes: FloatArray,
    either_side: BoolArray,
    rules: FitRules,
    fitted: FittedPlanes,
) -> None:
    """Fit a plane to every pair by Levenberg-Marquardt on the correlations, from several starts.

    Parameters
    ----------
    rho : float32, shape (e, p)
    used : bool, shape (e, p)
        Patches that take part; pairs without any keep what `fitted` holds.
    moved_mm : float64, shape (e, 2)
        In-plane displacement, by which lateral positions and levers are less.
    models : EchoModels
    levers : Levers
    curves : PatchCurves
    middle_mm : float64, shape (e,)
        Offset that fits start from.
    slopes : float64, shape (e, 2)
        As a sensor has them; else zero.
    either_side : bool, shape (e,)
        Whether planes of sensed slopes may have a negative offset.
    rules : FitRules
    fitted : FittedPlanes
        Receives the results.
    """
    most = rho.shape[1]
    patches = PairPatches(
        np.empty((7, most)),
        np.empty(most, np.int64),
        curves.amplitude.reshape(curves.amplitude.size),
        curves.amplitude.shape[1] - 1.001,
        curves.step_mm,
        curves.of_echo,
    )
    starts = np.zeros((_STARTS, 3))
    plane, expected, precision = np.empty(3), np.zeros(3), np.empty(3)
    precision[0] = 1e-6
    precision[1] = precision[2] = 1.0 / (rules.slope_sd * rules.slope_sd)
    for e in range(rho.shape[0]):
        size = gather(e, rho, used, moved_mm, models, levers, curves, patches)
        if size == 0:
            continue
        expected[1], expected[2] = slopes[e, 0], slopes[e, 1]
        lateral = patches.table[LATERAL]
        count = _list_starts(middle_mm[e], slopes[e], either_side[e], size, lateral, rules, starts)
        least = np.inf
        for n in range(count):
            for k in range(3):
                plane[k] = starts[n, k]
            cost, misfit = descend(plane, size, patches, expected, precision, rules)
            misfit += rules.crossing_evidence if n > 0 else 0.0
            if misfit < least:
                least = misfit
                fitted.cost[e] = cost
                for k in range(3):
                    fitted.coefficients[e, k] = plane[k]
            # As good as noise alone leaves it: no other plane is asked for.
            if not rules.sensed and misfit <= size - 3:
                break
        information = fitted.information[e]
        for k in range(3):
            for j in range(3):
                information[k, j] = precision[k] if j == k else 0.0
        best = fitted.coefficients[e]
        add_information(best, size, patches, rules, information)
