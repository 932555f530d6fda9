"""Run the filter forward over a recorded stretch, and smooth the stretch backward.

Inclination and turning are smoothed first, without the magnetometer, by a Rauch-Tung-Striebel pass over the
filter's steps. Then the heading's offset from north, one number that wanders as slowly as the gyroscope
allows, is smoothed over the field seen from those orientations. So iron cannot tilt the smoothed orientation.

The filter is `ErrorStateFilter`; here its arithmetic runs in a kernel, over all samples at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.kernels import orientation_arrays as places
from speckle3d.kernels.increments import orient_samples
from speckle3d.kernels.magnetism import judge_fields
from speckle3d.kernels.orientation import run_filter
from speckle3d.kernels.orientation_smoothing import middles_of, smooth_heading, smooth_steps
from xsens.fusion import detectors, errorstate
from xsens.fusion.increments import Samples
from xsens.fusion.settings import FusionSettings

_CHUNK = 64
"""Blocks summed with one bias, about two seconds; its later change is corrected to first order."""

_FIRST_S = 1.0
"""The first heading is the mean over this time, as in the filter."""


# -- forward


@dataclass(frozen=True)
class FilterState:
    """What the filter keeps from one stretch to the next, changed in place.

    Attributes
    ----------
    state : ndarray, shape (STATE,)
    covariance, fresh : ndarray, shape (13, 13)
        Now, and at a start.
    """

    state: FloatArray
    covariance: FloatArray
    fresh: FloatArray


def fresh_filter(settings: FusionSettings) -> FilterState:
    """The filter before the first stretch."""
    state = np.zeros(places.STATE)
    state[places.FIELD_MONITOR + places.FITTING] = detectors.UNDISTURBED_AFTER_S
    fresh = errorstate.start_covariance(settings)
    return FilterState(state, fresh.copy(), fresh)


@dataclass(frozen=True)
class FilterSteps:
    """What the filter leaves behind: a row for each of n increments, or for each of m samples.

    Attributes
    ----------
    last : ndarray of int, shape (n,)
        Sample after each increment's last.
    rows : ndarray, shape (n, STEP)
        Laid out in `orientation_arrays`; the properties are views.
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
    def start_bias(self) -> FloatArray:
        """Shape (n, 3)."""
        return self._three(places.STEP_START_BIAS)

    @property
    def matrix(self) -> FloatArray:
        """World from sensor after each increment's correction, shape (n, 3, 3)."""
        return self.rows[:, places.MATRIX : places.MATRIX + 9].reshape(-1, 3, 3)

    @property
    def bias(self) -> FloatArray:
        """Shape (n, 3)."""
        return self._three(places.STEP_BIAS)

    @property
    def sd_rad(self) -> FloatArray:
        """About the world's axes, shape (n, 3)."""
        return self._three(places.SD)

    @property
    def resting(self) -> BoolArray:
        """Shape (n,)."""
        return np.asarray(self.rows[:, places.RESTED] > 0.0)

    @property
    def disturbed(self) -> BoolArray:
        """Shape (n,)."""
        return np.asarray(self.rows[:, places.STRAYED] > 0.0)

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
        Time since the end of that stretch.
    covariances : bool
        Keep what smoothing needs.
    """
    per_block = max(1, round(settings.block_s / float(np.median(samples.step_s))))
    whole = len(samples) // per_block
    last = per_block * np.arange(1, whole + 1)
    if whole * per_block < len(samples):
        last = np.append(last, len(samples))
    n = len(last)
    wide = (n if covariances else 0, places.SMOOTHED, places.SMOOTHED)
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
        _limits(settings),
        steps.rows,
        steps.within,
        steps.covariance,
        steps.transition,
        _work(),
    )
    return steps


def _work() -> FloatArray:
    return np.zeros((places.WORK, places.SIZE))


def _limits(s: FusionSettings) -> FloatArray:
    """Limits of filter and field monitor in their places."""
    limits = np.full(places.LIMITS, np.nan)
    for place, value in (
        (places.GRAVITY, s.gravity_m_s2),
        (places.GYRO_NOISE, s.gyro_noise_rad_sqrt_s),
        (places.GYRO_SCALE_NOISE, s.gyro_scale_noise_sqrt_s),
        (places.BIAS_WALK, s.bias_walk_rad_s_sqrt_s),
        (places.SPEED_VARIANCE, 2.0 * s.speed_m_s**2 * s.speed_time_s),
        (places.REST_SPEED_VARIANCE, 2.0 * errorstate.REST_SPEED_M_S**2 * errorstate.REST_TIME_S),
        (places.FORCE_NOISE, s.force_noise_m_s_sqrt_s),
        (places.FIELD_SD, s.field_sd_rad),
        (places.FIELD_PLACE_S, s.field_place_s),
        (places.FIELD_NOISE, s.field_noise_rad_sqrt_s),
        (places.FIELD_OFF_S, s.field_off_s),
        (places.REST_NOISE, errorstate.REST_NOISE),
        (places.REST_BIAS_VARIANCE, errorstate.REST_BIAS_RAD**2),
        (places.FIRST_S, errorstate.START_S),
        (places.STILL_RATE, s.rest_rate_rad_s),
        (places.STILL_FORCE, s.rest_force_m_s2),
        (places.STILL_S, s.rest_after_s),
        (places.STILL_BIAS, s.rest_bias_rad_s),
        (places.REST_MEMORY_S, detectors.REST_MEMORY_S),
        (places.MAGNETIC, float(s.use_magnetometer)),
        (places.SMOOTHING_S, detectors.SMOOTHING_S),
        (places.UNDISTURBED_S, detectors.UNDISTURBED_AFTER_S),
        (places.TURNING, detectors.TURNING_RAD_S),
        (places.LEARNT_S, detectors.LEARNT_AFTER_S),
        (places.STARTING_S, detectors.STARTING_S),
        (places.IRON_MEMORY_S, detectors.IRON_MEMORY_S),
        (places.PROVED_S, detectors.PROVED_AFTER_S),
        (places.IRON_PRIOR, detectors.IRON_PRIOR),
        (places.UNEVEN, detectors.UNEVEN),
        (places.FIRST_LEARNT_S, detectors.FIRST_AFTER_S),
        (places.FIRST_UNEVEN, detectors.FIRST_UNEVEN),
        (places.STEEPEST, detectors.STEEPEST),
        (places.BETTER, detectors.BETTER),
        (places.NORM_TOLERANCE, s.norm_tolerance),
        (places.DIP_TOLERANCE, s.dip_tolerance_rad),
        (places.MEMORY_S, s.field_memory_s),
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
        World from sensor.
    bias_rad_s : ndarray, shape (steps + 1, 3)
    sd_rad : ndarray, shape (steps + 1, 3)
        Standard deviation about the world's axes.
    disturbed, resting : ndarray of bool, shape (steps,)
    """

    matrices: FloatArray
    bias_rad_s: FloatArray
    sd_rad: FloatArray
    disturbed: BoolArray
    resting: BoolArray


def smooth(samples: Samples, settings: FusionSettings) -> tuple[FilterSteps, Smoothed]:
    """Smooth one stretch, which must be longer than the filter's start, one second."""
    alone = replace(settings, use_magnetometer=False)
    steps = forward(samples, alone, fresh_filter(alone), covariances=True)
    n = len(steps.duration_s)
    bias_variance = np.diag(steps.covariance[-1])[errorstate.BIAS].copy()  # at the end of the stretch
    matrices, biases, sd = np.empty((n + 1, 9)), np.empty((n + 1, 3)), np.empty((n + 1, 3))
    first = int(np.argmax(steps.started))
    work = np.empty((31, 9))
    smooth_steps(steps.rows, steps.covariance, steps.transition, first, matrices, biases, sd, work)
    level = Smoothed(matrices.reshape(-1, 3, 3), biases, sd, np.zeros(n, dtype=bool), steps.resting)
    if not settings.use_magnetometer:
        return steps, level
    return steps, _pointed_north(steps, level, bias_variance, settings)


# -- heading


def _pointed_north(
    steps: FilterSteps, level: Smoothed, bias_variance: FloatArray, settings: FusionSettings
) -> Smoothed:
    """Turn a smoothed stretch to magnetic north by the field along it."""
    if np.isnan(steps.field_au[:, 0]).all():
        return level
    world, disturbed, variance = _readings(steps, level, settings)
    trusted = disturbed == 0.0
    north = np.where(trusted, -np.arctan2(world[:, 1], world[:, 0]), np.nan)
    nodes = len(level.matrices)
    states, covariances = np.empty((nodes, 5)), np.empty((nodes, 5, 5))
    smooth_heading(
        steps.rows,
        _flat(level.matrices),
        north,
        _heading_variance(steps, world, variance, level.sd_rad[1:], settings),
        _first_angle(steps, north),
        np.array([math.pi**2, *bias_variance, settings.field_sd_rad**2]),
        settings.field_place_s,
        settings.field_sd_rad,
        states,
        covariances,
        np.empty((23, 5)),
    )
    turns = Rotation.from_euler("z", states[:, :1]).as_matrix()
    sd = np.column_stack([level.sd_rad[:, :2], np.sqrt(np.maximum(covariances[:, 0, 0], 0.0))])
    return replace(level, matrices=turns @ level.matrices, sd_rad=sd, disturbed=disturbed == 1.0)


def _readings(
    steps: FilterSteps, level: Smoothed, settings: FusionSettings
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Field at every step, judged forward and backward in time; the better judgement of the two.

    Returns
    -------
    ndarray, shape (n, 3)
        The field without iron, in the world's axes.
    ndarray, shape (n,)
        Whether it is disturbed, one or zero; NaN where there is no reading.
    ndarray, shape (n,)
        Variance of its heading; see `FieldReading`.
    """
    n = len(steps.last)
    middles, rates, poses = np.empty((n, 9)), np.empty(n), _flat(level.matrices)
    middles_of(steps.rows, poses, level.bias_rad_s, middles, rates)
    judged = []
    for backward in (False, True):
        readings = np.empty((n, places.READING))
        monitor = np.zeros(places.MONITOR)
        monitor[places.FITTING] = detectors.UNDISTURBED_AFTER_S
        limits = _limits(settings)
        judge_fields(poses, middles, steps.rows, rates, backward, monitor, limits, readings, _work())
        world = readings[:, places.CLEAN : places.CLEAN + 3]
        judged.append((world, readings[:, places.DISTURBS], readings[:, places.VARIANCE]))
    (world, disturbed, variance), (other, bad, uncertain) = judged
    better = (bad < disturbed) | ((bad == disturbed) & (uncertain < variance))
    return (
        np.where(better[:, None], other, world),
        np.where(better, bad, disturbed),
        np.where(better, uncertain, variance),
    )


def _first_angle(steps: FilterSteps, north: FloatArray) -> float:
    """Mean heading of the first second of trusted field."""
    trusted = np.flatnonzero(np.isfinite(north))
    before = np.cumsum(steps.duration_s[trusted]) - steps.duration_s[trusted]
    return float(np.angle(np.exp(1j * north[trusted[before < _FIRST_S]]).sum()))


def _heading_variance(
    steps: FilterSteps, world: FloatArray, variance: FloatArray, sd_rad: FloatArray, settings: FusionSettings
) -> FloatArray:
    """Variance of heading readings: unevenness of the field, visible iron, error of the inclination."""
    steepness = world[:, 2] ** 2 / np.maximum(world[:, 0] ** 2 + world[:, 1] ** 2, 1e-12)
    tilt = steepness * (sd_rad[:, 0] ** 2 + sd_rad[:, 1] ** 2) / 2.0
    off = 2.0 * settings.field_off_s * (variance + tilt)
    return np.asarray((settings.field_noise_rad_sqrt_s**2 + off) / steps.duration_s)
