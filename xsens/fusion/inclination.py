"""Inclination and turning, without the magnetometer: the filter over samples, and its smoothing backward.

So iron cannot tilt the orientation; `heading` then turns it to north.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation import inclination as kernel
from xsens.fusion.readings import Samples
from xsens.fusion.settings import FusionSettings

CLAIMED = np.array([0.6, 0.6, 1.0])
"""Of the filter's deviation of inclination, what is claimed. The hand's velocity, an error that persists, is
taken for white noise as strong at low frequencies: so it is for the smoother, but the filter sees less of it.
Measured on twelve trials of BROAD (Laidig et al. 2021)."""


@lru_cache(maxsize=8)
def _limits(settings: FusionSettings) -> Any:
    """Settings that the filter uses, as its kernel takes them."""
    numbers = {name: float(value) for name, value in vars(settings).items()}
    return np.array([tuple(numbers.values())], [(name, "f8") for name in numbers])


@dataclass(frozen=True)
class FilterSteps:
    """Increments that some samples complete.

    Attributes
    ----------
    last : ndarray of int, shape (n,)
        Sample after each increment's last.
    rows : structured ndarray, shape (n,), of `speckle3d.kernels.orientation.inclination.STEP`
    covariance, transition : ndarray, shape (n, 9, 9), or (0, 9, 9) if they are not wanted
    xyzw : ndarray, shape (m, 4)
        Level axes from the sensor's at every sample, by what came before it.
    """

    last: IntArray
    rows: Any
    covariance: FloatArray
    transition: FloatArray
    xyzw: FloatArray


class InclinationFilter:
    """The filter over samples as they come; its heading starts at zero by definition."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._filter, self._unfinished = np.zeros(1, kernel.FILTER), np.zeros(1, kernel.STEP)
        tilt = 2.0 * settings.speed_m_s / settings.gravity_m_s2  # of the mean force over a second
        deviations = [tilt, tilt, 1e-6, *3 * [settings.bias_sd_rad_s], *3 * [2.0 * settings.speed_m_s]]
        self._filter["fresh"] = np.square(deviations)

    def begin(self, pause_s: float) -> None:
        """Find up again with the next sample, so long after the one before."""
        self._filter["pause_s"] = pause_s

    def run(self, samples: Samples, to_end: bool, covariances: bool = False) -> FilterSteps:
        """Run the filter over samples without a pause.

        Parameters
        ----------
        samples : Samples
        to_end : bool
            The last one completes an increment, however short.
        covariances : bool
            Keep what smoothing needs.
        """
        m = len(samples)
        most = min(m, int(2.0 * samples.step_s.sum() / self._settings.block_s) + 2)
        last, rows, xyzw = np.empty(most, np.int64), np.zeros(most, kernel.STEP), np.empty((m, 4))
        covariance, transition = np.empty((2, most if covariances else 0, kernel.SIZE, kernel.SIZE))
        arguments: list[Any] = [np.ascontiguousarray(values) for values in vars(samples).values()]
        arguments += [to_end, self._filter, _limits(self._settings), self._unfinished]
        run: Any = kernel.run_filter
        n = run(*arguments, rows, last, covariance, transition, xyzw)
        return FilterSteps(last[:n], rows[:n], covariance[:n], transition[:n], xyzw)


def smooth(
    samples: Samples, settings: FusionSettings
) -> tuple[FilterSteps, FloatArray, FloatArray, FloatArray]:
    """Smooth one stretch, which must be longer than the filter's start, one second.

    Returns
    -------
    FilterSteps
    ndarray, shape (n + 1, 4)
        World from sensor at the start and at the end of each step; the heading starts at zero.
    ndarray, shape (n + 1, 3)
        Bias of the gyroscope, rad/s.
    ndarray, shape (n + 1, 6)
        Standard deviation about the world's axes, rad, and of the bias.
    """
    steps = InclinationFilter(settings).run(samples, to_end=True, covariances=True)
    n, first = len(steps.last), int(np.argmax(steps.rows["started"]))
    levels, biases = np.empty((n + 1, 4)), np.empty((n + 1, 3))
    kernel.smooth_steps(steps.rows, steps.covariance, steps.transition, first, levels, biases)
    variance = np.diagonal(steps.covariance, axis1=1, axis2=2)[np.maximum(np.arange(-1, n), first), :6]
    return steps, levels, biases, np.sqrt(np.maximum(variance, 0.0))


def within_steps(samples: Samples, steps: FilterSteps, nodes: FloatArray, biases: FloatArray) -> FloatArray:
    """World from sensor at every sample, between nodes at the ends of steps; quaternions, scalar last."""
    xyzw = np.empty((len(samples), 4))
    still = np.ascontiguousarray(steps.rows["resting"])
    rates = np.ascontiguousarray(samples.rate_rad_s)
    kernel.orient_samples(samples.step_s, rates, steps.last, still, nodes, biases, xyzw)
    return xyzw
