"""Inclination and turning, without the magnetometer: the filter over a stretch, and its smoothing backward.

So iron cannot tilt the orientation; `heading` then turns it to north.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation import inclination as kernel
from xsens.fusion.samples import Samples
from xsens.fusion.settings import FusionSettings

CLAIMED = np.array([0.6, 0.6, 1.0])
"""Of the filter's deviation of inclination, what is claimed. The hand's velocity, an error that persists, is
taken for white noise as strong at low frequencies: so it is for the smoother, but the filter sees less of it.
Measured on twelve trials of BROAD (Laidig et al. 2021)."""


def fresh_filter(settings: FusionSettings) -> Any:
    """The filter before the first stretch; its heading starts at zero by definition."""
    fresh = np.zeros(1, kernel.FILTER)
    tilt = 2.0 * settings.speed_m_s / settings.gravity_m_s2  # of the mean force over a second
    deviations = [tilt, tilt, 1e-6, *3 * [settings.bias_sd_rad_s], *3 * [2.0 * settings.speed_m_s]]
    fresh["fresh"], fresh["level"] = np.square(deviations), [0.0, 0.0, 0.0, 1.0]
    fresh["p"] = np.diag(fresh["fresh"][0])
    return fresh


@lru_cache(maxsize=8)
def _limits(settings: FusionSettings) -> Any:
    """Settings that the filter uses, as its kernel takes them."""
    values = tuple(getattr(settings, name) for name in kernel.LIMITS.names or ())
    return np.array([values], kernel.LIMITS)


@dataclass(frozen=True)
class FilterSteps:
    """What the filter leaves behind of n increments.

    Attributes
    ----------
    last : ndarray of int, shape (n,)
        Sample after each increment's last.
    rows : structured ndarray, shape (n,), of `speckle3d.kernels.orientation.inclination.STEP`
    covariance, transition : ndarray, shape (n, 9, 9), or (0, 9, 9) if they are not wanted
    """

    last: IntArray
    rows: Any
    covariance: FloatArray
    transition: FloatArray


def forward(
    samples: Samples,
    settings: FusionSettings,
    kept: Any,
    pause_s: float = 0.0,
    covariances: bool = False,
    whole: bool = False,
) -> FilterSteps:
    """Run the filter over a stretch.

    Parameters
    ----------
    samples : Samples
        One stretch without a pause.
    settings : FusionSettings
    kept : structured ndarray
        The filter at the end of the stretch before, or a fresh one; changed in place.
    pause_s : float
        Time since the end of that stretch; `GOES_ON` if this one continues it.
    covariances : bool
        Keep what smoothing needs.
    whole : bool
        These are the samples of one increment.
    """
    per_block = max(1, round(settings.block_s / float(np.mean(samples.step_s))))
    last = np.arange(per_block, len(samples), per_block)
    last = np.append([] if whole else last, len(samples)).astype(np.int64)
    n = len(last)
    wide = (n if covariances else 0, kernel.SIZE, kernel.SIZE)
    steps = FilterSteps(last, np.zeros(n, kernel.STEP), np.empty(wide), np.empty(wide))
    kernel.run_filter(
        _plain(samples.step_s),
        _plain(samples.rate_rad_s),
        _plain(samples.force_m_s2),
        _plain(samples.field_au),
        _plain(samples.lost_rad2),
        last,
        pause_s,
        kept,
        _limits(settings),
        steps.rows,
        steps.covariance,
        steps.transition,
    )
    return steps


def _plain(values: FloatArray) -> FloatArray:
    """Values as kernels are compiled for."""
    return np.ascontiguousarray(values)


def within_steps(
    samples: Samples,
    steps: FilterSteps,
    starts: FloatArray,
    biases_rad_s: FloatArray,
    ends: FloatArray | None = None,
) -> FloatArray:
    """World from sensor at every sample, by the gyroscope from the steps' starts; quaternions, scalar last.

    Parameters
    ----------
    samples : Samples
    steps : FilterSteps
    starts, biases_rad_s : ndarray, shapes (n, 4) and (n, 3)
        Of each step; a resting sensor stays at its step's start.
    ends : ndarray, shape (n, 4), optional
        At the end of each step; the gyroscope's error there is spread over the step.
    """
    xyzw, there = np.empty((len(samples), 4)), np.empty((0, 4)) if ends is None else ends
    step_s, rate, still = map(_plain, (samples.step_s, samples.rate_rad_s, steps.rows["resting"]))
    kernel.orient_samples(step_s, rate, steps.last, still, starts, _plain(biases_rad_s), there, xyzw)
    return xyzw


@dataclass(frozen=True)
class Smoothed:
    """Smoothed orientation at the start of a stretch and at the end of each step.

    Attributes
    ----------
    levels : ndarray, shape (steps + 1, 4)
        World from sensor; the heading starts at zero.
    bias_rad_s, bias_sd_rad_s : ndarray, shape (steps + 1, 3)
    sd_rad : ndarray, shape (steps + 1, 3)
        Standard deviation about the world's axes.
    """

    levels: FloatArray
    bias_rad_s: FloatArray
    bias_sd_rad_s: FloatArray
    sd_rad: FloatArray


def smooth(samples: Samples, settings: FusionSettings) -> tuple[FilterSteps, Smoothed]:
    """Smooth one stretch, which must be longer than the filter's start, one second."""
    steps = forward(samples, settings, fresh_filter(settings), covariances=True)
    n, first = len(steps.last), int(np.argmax(steps.rows["started"]))
    levels, biases = np.empty((n + 1, 4)), np.empty((n + 1, 3))
    kernel.smooth_steps(steps.rows, steps.covariance, steps.transition, first, levels, biases)
    variance = np.diagonal(steps.covariance, axis1=1, axis2=2)[np.maximum(np.arange(-1, n), first)]
    sd = np.sqrt(np.maximum(variance, 0.0))
    return steps, Smoothed(levels, biases, sd[:, 3:6], sd[:, :3])
