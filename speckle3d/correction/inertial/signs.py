"""Signs of image steps by the accelerometer: at which turns of the probe the images went on the wrong way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.leastsquares import robust_sigma

_SCALES = np.exp(np.linspace(-0.3, 0.3, 7))
_CLOCK_STEP_S = 0.005
_ERROR_MM = 0.01
"""Least error of a felt change of step: a good accelerometer's noise, integrated twice over a frame."""
_SHARE = 0.1
"""Error of a step over its size while clock and scale are settled roughly."""
_TURN_COST = 12.0
"""Squared deviations by which the accelerometer must speak for a turn that the images do not have, or against
one that they have. A run of wrong signs has two wrong turns, and every change of speed within speaks."""
_CAP = 25.0
"""Most squared deviations that one change of step counts for: some frames are wrong altogether."""


@dataclass(frozen=True)
class SettledSigns:
    """Image steps against felt changes of speed.

    Attributes
    ----------
    turned : ndarray of bool, shape (n - 1,)
        Steps that go the other way than the images have them.
    clock_s, log_scale : float
        What fits best on a rough grid.
    certainty : float
        Squared deviations by which the mirror image of the whole would fit worse.
    """

    turned: BoolArray
    clock_s: float
    log_scale: float
    certainty: float


def settled_signs(
    felt_mm: Callable[[FloatArray], FloatArray],
    time_s: FloatArray,
    steps_mm: FloatArray,
    clock_range_s: float,
) -> SettledSigns:
    """Find the signs that fit the changes of speed that are felt: Viterbi's algorithm over both signs.

    Parameters
    ----------
    felt_mm : callable
        Elevational position at some times by inertial readings alone, but for a slow drift.
    time_s : ndarray, shape (n,)
    steps_mm : ndarray, shape (n - 1,)
    clock_range_s : float
        Offsets of the clock up to this are tried.
    """
    half = round(clock_range_s / _CLOCK_STEP_S)
    clocks = _CLOCK_STEP_S * np.arange(-half, half + 1)
    changes = np.array([np.diff(felt_mm(time_s + clock), 2) for clock in clocks])
    # An accelerometer's bias is a constant change of step.
    changes -= np.median(changes, axis=1, keepdims=True)
    clock, scale = (grid.ravel() for grid in np.meshgrid(np.arange(clocks.size), _SCALES, indexing="ij"))
    felt, steps = changes[clock], scale[:, None] * steps_mm
    error_mm = _ERROR_MM
    for _ in range(2):
        variance = error_mm**2 + _SHARE**2 * (steps[:, 1:] ** 2 + steps[:, :-1] ** 2)
        cost, signs = _viterbi(steps, felt, variance)
        best = int(np.argmin(cost))
        change = np.diff(signs[best] * steps[best])
        error_mm = robust_sigma(change - felt[best], _ERROR_MM)
    straight, mirrored = (
        np.minimum((sign * change - felt[best]) ** 2 / variance[best], _CAP).sum() for sign in (1.0, -1.0)
    )
    return SettledSigns(
        signs[best] < 0, float(clocks[clock[best]]), float(np.log(scale[best])), float(mirrored - straight)
    )


def _viterbi(steps: FloatArray, felt: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least costs, shape (g,), and the signs that have them, shape (g, n - 1)."""
    sign = np.array([1.0, -1.0])
    grid, count = steps.shape
    cost = np.zeros((grid, 2))
    came = np.zeros((count, grid, 2), dtype=int)
    for i in range(1, count):
        after, before = sign[None, :, None] * steps[:, None, i, None], sign * steps[:, None, i - 1, None]
        off = after - before - felt[:, i - 1, None, None]
        way = np.minimum(off**2 / variance[:, i - 1, None, None], _CAP) + _TURN_COST * (1.0 - np.eye(2))
        total = cost[:, None, :] + way
        came[i] = np.argmin(total, axis=2)
        cost = np.min(total, axis=2)
    at = np.argmin(cost, axis=1)
    signs = np.empty((grid, count))
    for i in range(count - 1, -1, -1):
        signs[:, i] = sign[at]
        at = came[i][np.arange(grid), at]
    return np.min(cost, axis=1), signs
