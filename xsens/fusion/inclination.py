"""Inclination and turning, without the magnetometer: the filter over a stretch, and its smoothing backward.

So iron cannot tilt the orientation; `heading` then turns it to north.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.kernels.orientation import inclination_arrays as places
from speckle3d.kernels.orientation.inclination import run_filter
from speckle3d.kernels.orientation.increments import orient_samples
from speckle3d.kernels.orientation.smoothing import smooth_steps
from xsens.fusion.samples import Samples
from xsens.fusion.settings import LOST, FusionSettings

_CHUNK = 64
"""Blocks summed with one bias, about two seconds; its later change is corrected to first order."""

START_S, MOVING_START_S = 1.0, 3.0
"""Inclination at the start is that of the mean force over this time, at rest and in movement."""

REST_SPEED_M_S = 0.02
REST_TIME_S = 0.5
"""Standard deviation of a resting sensor's velocity, and how long the accelerometer's error persists."""

REST_BIAS_RAD = math.radians(0.03)
"""Error of the bias after one second of rest: an MT9-B's Allan deviation at 1 s is 0.05 deg/s."""

REST_NOISE = 0.1
"""Random walk of a resting sensor's attitude, as a fraction of the gyroscope's. The gyroscope is not
integrated at rest; this allows for turning too slow to notice."""

CLAIMED = 0.6
"""Of the filter's deviation of inclination, what is claimed. The hand's velocity, an error that persists, is
taken for white noise as strong at low frequencies: so it is for the smoother, but the filter sees less of it.
Measured on twelve trials of BROAD (Laidig et al. 2021)."""

REST_MEMORY_S = 0.5
"""Time over which a resting sensor's readings are averaged."""


# -- forward


@dataclass(frozen=True)
class FilterState:
    """What the filter keeps from one stretch to the next, changed in place.

    Attributes
    ----------
    state : ndarray, shape (STATE,)
    covariance, fresh : ndarray, shape (9, 9)
        Now, and at a start.
    """

    state: FloatArray
    covariance: FloatArray
    fresh: FloatArray


def fresh_filter(settings: FusionSettings) -> FilterState:
    """The filter before the first stretch; its heading starts at zero by definition."""
    tilt = 2.0 * settings.speed_m_s / (settings.gravity_m_s2 * START_S)
    deviations = [tilt, tilt, 1e-6, *3 * [settings.bias_sd_rad_s], *3 * [2.0 * settings.speed_m_s]]
    fresh = np.diag(np.square(deviations))
    return FilterState(np.zeros(places.STATE), fresh.copy(), fresh)


@dataclass(frozen=True)
class FilterSteps:
    """What the filter leaves behind: a row for each of n increments, or for each of m samples.

    Attributes
    ----------
    last : ndarray of int, shape (n,)
        Sample after each increment's last.
    rows : ndarray, shape (n, STEP)
        Laid out in `inclination_arrays`; the properties are views.
    within : ndarray, shape (m, SAMPLE)
    covariance, transition : ndarray, shape (n, 9, 9), or (0, 9, 9) if they are not wanted
    """

    last: IntArray
    rows: FloatArray
    within: FloatArray
    covariance: FloatArray
    transition: FloatArray

    @property
    def duration_s(self) -> FloatArray:
        """Shape (n,)."""
        return self.rows[:, places.DURATION]

    @property
    def field_au(self) -> FloatArray:
        """Mean field, shape (n, 3); NaN where there is none."""
        return self._three(places.FIELD)

    @property
    def start(self) -> FloatArray:
        """World from sensor before each increment, shape (n, 3, 3)."""
        return self.rows[:, places.STEP_START : places.STEP_START + 9].reshape(-1, 3, 3)

    @property
    def start_bias_rad_s(self) -> FloatArray:
        """Shape (n, 3)."""
        return self._three(places.STEP_START_BIAS)

    @property
    def predicted(self) -> FloatArray:
        """World from sensor after each increment, before its correction, shape (n, 3, 3)."""
        return self.rows[:, places.PREDICTED : places.PREDICTED + 9].reshape(-1, 3, 3)

    @property
    def corrected(self) -> FloatArray:
        """World from sensor after each increment's correction, shape (n, 3, 3)."""
        return self.rows[:, places.MATRIX : places.MATRIX + 9].reshape(-1, 3, 3)

    @property
    def bias_rad_s(self) -> FloatArray:
        """Shape (n, 3)."""
        return self._three(places.STEP_BIAS)

    @property
    def rate_rad_s(self) -> FloatArray:
        """Mean reading of the gyroscope, shape (n, 3)."""
        return self._three(places.RATE)

    @property
    def slip_rad2(self) -> FloatArray:
        """Variance of the turn about up that each step adds, shape (n,)."""
        return self.rows[:, places.NOISE + 2]

    @property
    def sd_rad(self) -> FloatArray:
        """About the world's axes, shape (n, 3)."""
        return self._three(places.DEVIATION)

    @property
    def claimed_sd_rad(self) -> FloatArray:
        """The same as claimed of the filter, shape (n, 3): of inclination less."""
        return self.sd_rad * [CLAIMED, CLAIMED, 1.0]

    @property
    def bias_sd_rad_s(self) -> FloatArray:
        """Shape (n, 3)."""
        return self._three(places.DEVIATION + 3)

    @property
    def resting(self) -> BoolArray:
        """Shape (n,)."""
        return np.asarray(self.rows[:, places.RESTED] > 0.0)

    @property
    def started(self) -> BoolArray:
        """Shape (n,)."""
        return np.asarray(self.rows[:, places.STARTED] > 0.0)

    def _three(self, first: int) -> FloatArray:
        return self.rows[:, first : first + 3]


def forward(
    samples: Samples,
    settings: FusionSettings,
    kept: FilterState,
    pause_s: float = 0.0,
    covariances: bool = False,
    heading_apart: bool = False,
    usual_s: float | None = None,
) -> FilterSteps:
    """Run the filter over a stretch.

    Parameters
    ----------
    samples : Samples
        One stretch without a pause.
    settings : FusionSettings
    kept : FilterState
        The filter at the end of the stretch before, or a fresh one; changed in place.
    pause_s : float
        Time since the end of that stretch; `GOES_ON` if this one continues it.
    covariances : bool
        Keep what smoothing needs.
    heading_apart : bool
        Leave the heading to the gyroscope, whose bias is known at each time: corrections of it are made
        elsewhere.
    usual_s : float, optional
        Usual step between samples, if these are the samples of one increment alone; by default their median.
    """
    per_block = max(1, round(settings.block_s / float(np.mean(samples.step_s))))
    last = np.arange(per_block, len(samples), per_block)
    last = np.append([] if usual_s is not None else last, len(samples))
    n = len(last)
    wide = (n if covariances else 0, places.SIZE, places.SIZE)
    shapes = ((n, places.STEP), (len(samples), places.SAMPLE), wide, wide)
    steps = FilterSteps(last.astype(np.int64), *map(np.empty, shapes))
    run_filter(
        np.ascontiguousarray(samples.step_s, dtype=float),
        np.ascontiguousarray(samples.rate_rad_s, dtype=float),
        np.ascontiguousarray(samples.force_m_s2, dtype=float),
        np.ascontiguousarray(samples.field_au, dtype=float),
        steps.last,
        _CHUNK,
        pause_s,
        kept.state,
        kept.covariance,
        kept.fresh,
        _limits(settings, heading_apart, usual_s or float(np.median(samples.step_s))),
        steps.rows,
        steps.within,
        steps.covariance,
        steps.transition,
        np.zeros((places.WORK, places.SIZE)),
    )
    return steps


def joined(parts: list[FilterSteps]) -> FilterSteps:
    """Steps of several runs, one after another, without the samples within them."""
    rows = np.concatenate([part.rows for part in parts])
    none = np.empty((0, places.SIZE, places.SIZE))
    return FilterSteps(np.arange(1, len(rows) + 1), rows, np.empty((0, places.SAMPLE)), none, none)


def _limits(s: FusionSettings, heading_apart: bool, usual_s: float) -> FloatArray:
    """Limits of the filter in their places."""
    limits = np.full(places.LIMITS, np.nan)
    for place, value in (
        (places.GRAVITY, s.gravity_m_s2),
        (places.GYRO_NOISE, s.gyro_noise_rad_sqrt_s),
        (places.GYRO_SCALE_NOISE, s.gyro_scale_noise_sqrt_s),
        (places.BIAS_WALK, s.bias_walk_rad_s_sqrt_s),
        (places.SPEED_VARIANCE, 2.0 * s.speed_m_s**2 * s.speed_time_s),
        (places.REST_SPEED_VARIANCE, 2.0 * REST_SPEED_M_S**2 * REST_TIME_S),
        (places.FORCE_NOISE, s.force_noise_m_s_sqrt_s),
        (places.REST_NOISE, REST_NOISE),
        (places.REST_BIAS_VARIANCE, REST_BIAS_RAD**2),
        (places.FIRST_S, START_S),
        (places.FIRST_MOVING_S, MOVING_START_S),
        (places.STILL_RATE, s.rest_rate_rad_s),
        (places.STILL_FORCE, s.rest_force_m_s2),
        (places.STILL_S, s.rest_after_s),
        (places.STILL_BIAS, s.rest_bias_rad_s),
        (places.REST_MEMORY_S, REST_MEMORY_S),
        (places.HEADING_APART, float(heading_apart)),
        (places.LONGEST_S, LOST * usual_s),
    ):
        limits[place] = value
    return limits


def within_steps(
    steps: FilterSteps, starts: FloatArray, biases_rad_s: FloatArray, ends: FloatArray | None = None
) -> FloatArray:
    """World from sensor at every sample, by the gyroscope from the steps' starts; quaternions, scalar last.

    Parameters
    ----------
    starts, biases_rad_s : ndarray, shapes (n, 3, 3) and (n, 3)
        Of each step; a resting sensor stays at its step's start.
    ends : ndarray, shape (n, 3, 3), optional
        At the end of each step; the gyroscope's error there is spread over the step.
    """
    xyzw = np.empty((len(steps.within), 4))
    biases = np.ascontiguousarray(biases_rad_s)
    there = np.empty((0, 9)) if ends is None else _flat(ends)
    orient_samples(steps.last, steps.rows, steps.within, _flat(starts), biases, there, xyzw)
    return xyzw


def _flat(matrices: FloatArray) -> FloatArray:
    """Rows of nine numbers."""
    return np.ascontiguousarray(matrices).reshape(-1, 9)


# -- backward


@dataclass(frozen=True)
class Smoothed:
    """Smoothed orientation at the start of a stretch and at the end of each step.

    Attributes
    ----------
    matrices : ndarray, shape (steps + 1, 3, 3)
        World from sensor; the heading starts at zero.
    bias_rad_s, bias_sd_rad_s : ndarray, shape (steps + 1, 3)
    sd_rad : ndarray, shape (steps + 1, 3)
        Standard deviation about the world's axes.
    """

    matrices: FloatArray
    bias_rad_s: FloatArray
    bias_sd_rad_s: FloatArray
    sd_rad: FloatArray


def smooth(samples: Samples, settings: FusionSettings) -> tuple[FilterSteps, Smoothed]:
    """Smooth one stretch, which must be longer than the filter's start, one second."""
    steps = forward(samples, settings, fresh_filter(settings), covariances=True)
    n = len(steps.duration_s)
    matrices, biases, sd = np.empty((n + 1, 9)), np.empty((n + 1, 3)), np.empty((n + 1, 3))
    first = int(np.argmax(steps.started))
    work = np.empty((31, 9))
    smooth_steps(steps.rows, steps.covariance, steps.transition, first, matrices, biases, sd, work)
    variance = np.diagonal(steps.covariance[:, 3:6, 3:6], axis1=1, axis2=2)
    bias_sd = np.sqrt(np.maximum(variance[np.maximum(np.arange(-1, n), first)], 0.0))
    return steps, Smoothed(matrices.reshape(-1, 3, 3), biases, bias_sd, sd)
