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

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.kernels.magnetism import CANDIDATE, FITTING, MONITOR, FieldLimits, judge_fields
from speckle3d.kernels.orientation import (
    SMOOTHED,
    STATE,
    FilterLimits,
    FilterState,
    run_filter,
)
from speckle3d.kernels.orientation import FilterSteps as FilterSteps
from speckle3d.kernels.orientation_smoothing import middles_of, orient_samples, smooth_heading, smooth_steps
from xsens.fusion import detectors, errorstate
from xsens.fusion.increments import Samples
from xsens.fusion.settings import FusionSettings

_CHUNK = 64
"""Blocks summed with one bias, about two seconds; its later change is corrected to first order."""

_FIRST_S = 1.0
"""The first heading is the mean over this time, as in the filter."""


# -- forward


def fresh_filter(settings: FusionSettings) -> FilterState:
    """The filter before the first stretch."""
    monitor = np.zeros(MONITOR)
    monitor[FITTING] = detectors.UNDISTURBED_AFTER_S
    fresh = errorstate.start_covariance(settings)
    return FilterState(
        fresh.copy(),
        fresh,
        np.eye(3),
        np.eye(3),
        np.zeros(STATE),
        monitor,
        np.zeros(CANDIDATE),
        np.zeros(CANDIDATE),
    )


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
    steps = _room(last, len(samples), covariances)
    run_filter(
        np.ascontiguousarray(samples.step_s, dtype=float),
        np.ascontiguousarray(samples.rate_rad_s, dtype=float),
        np.ascontiguousarray(samples.force_m_s2, dtype=float),
        np.ascontiguousarray(samples.field_au, dtype=float),
        _CHUNK,
        pause_s,
        kept,
        _limits(settings),
        _field_limits(settings),
        steps,
    )
    return steps


def _room(last: np.ndarray, samples: int, covariances: bool) -> FilterSteps:
    n = len(last)
    one, three, square = (n,), (n, 3), (n, 3, 3)
    wide = (n if covariances else 0, SMOOTHED, SMOOTHED)
    shapes = (one, three, three, three, square, square, square, square, three, three, three, three)
    more = (wide, wide, (n, SMOOTHED), three, one, one, one, (samples, 4), (samples,))
    return FilterSteps(last.astype(np.int64), *map(np.empty, (*shapes, *more)))


def _limits(s: FusionSettings) -> FilterLimits:
    return FilterLimits(
        s.gravity_m_s2,
        s.gyro_noise_rad_sqrt_s,
        s.gyro_scale_noise_sqrt_s,
        s.bias_walk_rad_s_sqrt_s,
        2.0 * s.speed_m_s**2 * s.speed_time_s,
        2.0 * errorstate.REST_SPEED_M_S**2 * errorstate.REST_TIME_S,
        s.force_noise_m_s_sqrt_s,
        s.field_sd_rad,
        s.field_place_s,
        s.field_noise_rad_sqrt_s,
        s.field_off_s,
        errorstate.REST_NOISE,
        errorstate.REST_BIAS_RAD**2,
        errorstate.START_S,
        s.rest_rate_rad_s,
        s.rest_force_m_s2,
        s.rest_after_s,
        s.rest_bias_rad_s,
        detectors.REST_MEMORY_S,
        s.use_magnetometer,
    )


def _field_limits(s: FusionSettings) -> FieldLimits:
    return FieldLimits(
        detectors.SMOOTHING_S,
        detectors.UNDISTURBED_AFTER_S,
        detectors.TURNING_RAD_S,
        detectors.LEARNT_AFTER_S,
        detectors.STARTING_S,
        detectors.IRON_MEMORY_S,
        detectors.PROVED_AFTER_S,
        detectors.IRON_PRIOR,
        detectors.UNEVEN,
        detectors.FIRST_AFTER_S,
        detectors.FIRST_UNEVEN,
        detectors.STEEPEST,
        detectors.BETTER,
        s.norm_tolerance,
        s.dip_tolerance_rad,
        s.field_memory_s,
    )


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
    xyzw = np.empty((len(steps.time_s), 4))
    orient_samples(steps, starts, biases_rad_s, np.empty((0, 3, 3)) if ends is None else ends, xyzw)
    return xyzw


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
    matrices, biases, sd = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3)), np.empty((n + 1, 3))
    smooth_steps(steps, int(np.argmax(steps.started)), matrices, biases, sd)
    level = Smoothed(matrices, biases, sd, np.zeros(n, dtype=bool), steps.resting > 0.0)
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
    angle, angle_variance = np.empty(len(level.matrices)), np.empty(len(level.matrices))
    smooth_heading(
        steps,
        level.matrices,
        north,
        _heading_variance(steps, world, variance, level.sd_rad[1:], settings),
        _first_angle(steps, north),
        np.array([math.pi**2, *bias_variance, settings.field_sd_rad**2]),
        settings.field_place_s,
        settings.field_sd_rad,
        angle,
        angle_variance,
    )
    turns = Rotation.from_euler("z", angle[:, None]).as_matrix()
    sd = np.column_stack([level.sd_rad[:, :2], np.sqrt(np.maximum(angle_variance, 0.0))])
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
    n = len(steps.duration_s)
    middles, rates = np.empty((n, 3, 3)), np.empty(n)
    middles_of(steps, level.matrices, level.bias_rad_s, middles, rates)
    judged = []
    for backward in (False, True):
        world, disturbed, variance = np.empty((n, 3)), np.empty(n), np.empty(n)
        judge_fields(
            level.matrices,
            middles,
            steps.field_au,
            rates,
            steps.duration_s,
            backward,
            _field_limits(settings),
            world,
            disturbed,
            variance,
        )
        judged.append((world, disturbed, variance))
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
