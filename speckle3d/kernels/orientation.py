"""The orientation filter over a stretch of samples: the arithmetic of `xsens.fusion.errorstate`.

`ErrorStateFilter` there says what is done and why, step by step and with filterpy's Kalman filter; this runs
the same on bare arrays, samples and increments included.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.magnetism import FieldLimits, read_field
from speckle3d.kernels.rotations import (
    apply_into,
    matrix_into,
    multiplied,
    product_into,
    quaternion_of,
    solve_into,
    turn_into,
)

SIZE = 13
"""Attitude, bias, velocity, bias by all observations, field's angle: see `xsens.fusion.errorstate`."""

SMOOTHED = 9
"""States that are smoothed: without the magnetometer there is one bias."""


class FilterLimits(NamedTuple):
    """Constants of the filter, and those of its settings that it uses; see `FusionSettings`."""

    gravity_m_s2: float
    gyro_noise: float
    gyro_scale_noise: float
    bias_walk: float
    speed_variance: float
    rest_speed_variance: float
    force_noise: float
    field_sd_rad: float
    field_place_s: float
    field_noise: float
    field_off_s: float
    rest_noise: float
    rest_bias_variance: float
    start_s: float
    rest_rate_rad_s: float
    rest_force_m_s2: float
    rest_after_s: float
    rest_bias_rad_s: float
    rest_memory_s: float
    magnetic: bool


RUNNING, STARTING, HEADING, STRAY, RESTING, DISTURBED, SPEED, BIAS, NORTH_BIAS = 0, 1, 2, 3, 4, 5, 6, 9, 12
REST_KNOWN, REST_RATE, REST_FORCE, STILL = 15, 16, 19, 22
START_S, START_FIELD_S, START_FORCE, START_FIELD, STATE = 23, 24, 25, 28, 31
"""Places in the state's vector: flags, angles, velocity, both biases; rest detector; the start's means."""


class FilterState(NamedTuple):
    """What the filter keeps from one stretch to the next, changed in place.

    Attributes
    ----------
    covariance : ndarray, shape (13, 13)
    fresh : ndarray, shape (13, 13)
        Covariance at a start.
    level : ndarray, shape (3, 3)
        Level axes from the sensor's, without the heading.
    start_turn : ndarray, shape (3, 3)
        First axes of a start from the present ones.
    state : ndarray, shape (STATE,)
    monitor, candidate, known : ndarray
        See `read_field`.
    """

    covariance: FloatArray
    fresh: FloatArray
    level: FloatArray
    start_turn: FloatArray
    state: FloatArray
    monitor: FloatArray
    candidate: FloatArray
    known: FloatArray


class FilterSteps(NamedTuple):
    """What the filter leaves behind: a row for each of n increments, or for each of m samples.

    Attributes
    ----------
    last : ndarray of int, shape (n,)
        Sample after each increment's last.
    duration_s : ndarray, shape (n,)
    rate_rad_s, field_au, assumed_bias : ndarray, shape (n, 3)
        Mean gyroscope; mean field, NaN where there is none; the bias with which turns were summed.
    turn : ndarray, shape (n, 3, 3)
        Start from end of the increment.
    start, predicted, matrix : ndarray, shape (n, 3, 3)
        World from sensor before the increment, after it (without the heading), and after its correction.
    start_bias, predicted_velocity, velocity, bias : ndarray, shape (n, 3)
    covariance, transition : ndarray, shape (n, 9, 9), or (0, 9, 9) if they are not wanted
    noise : ndarray, shape (n, 9)
        The diagonal of the step's noise.
    sd_rad : ndarray, shape (n, 3)
    resting, disturbed, started : ndarray, shape (n,)
        One or zero.
    turns_xyzw : ndarray, shape (m, 4)
        Start of the increment from each sample.
    time_s : ndarray, shape (m,)
        Of each sample since the start of its increment.
    """

    last: IntArray
    duration_s: FloatArray
    rate_rad_s: FloatArray
    field_au: FloatArray
    assumed_bias: FloatArray
    turn: FloatArray
    start: FloatArray
    predicted: FloatArray
    matrix: FloatArray
    start_bias: FloatArray
    predicted_velocity: FloatArray
    velocity: FloatArray
    bias: FloatArray
    covariance: FloatArray
    transition: FloatArray
    noise: FloatArray
    sd_rad: FloatArray
    resting: FloatArray
    disturbed: FloatArray
    started: FloatArray
    turns_xyzw: FloatArray
    time_s: FloatArray


class _Work(NamedTuple):
    """Buffers of one run."""

    force: FloatArray
    transition: FloatArray
    noise: FloatArray
    wide: FloatArray
    cross: FloatArray
    gain: FloatArray
    innovation: FloatArray
    residual: FloatArray
    shows: FloatArray
    before: FloatArray
    a: FloatArray
    clean: FloatArray
    restart: FloatArray
    field: FloatArray
    rows_and_mask: IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def run_filter(
    step_s: FloatArray,
    rate_rad_s: FloatArray,
    force_m_s2: FloatArray,
    field_au: FloatArray,
    chunk: int,
    pause_s: float,
    filt: FilterState,
    limits: FilterLimits,
    field_limits: FieldLimits,
    steps: FilterSteps,
) -> None:
    """Run the filter over a stretch.

    Parameters
    ----------
    step_s : ndarray, shape (m,)
    rate_rad_s, force_m_s2, field_au : ndarray, shape (m, 3)
    chunk : int
        Increments summed with one bias.
    pause_s : float
        Time since the stretch before, of which `filt` is the end.
    steps : FilterSteps
        Filled; `last` is given.
    """
    work = _Work(
        np.empty(3),
        np.eye(SIZE),
        np.zeros((SIZE, SIZE)),
        np.empty((SIZE, SIZE)),
        np.empty((3, SIZE)),
        np.empty((3, SIZE)),
        np.empty((3, 3)),
        np.empty(3),
        np.zeros((3, SIZE)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.zeros(2, np.int64),
    )
    s, last = filt.state, steps.last
    assumed = np.empty(3)
    whole = last.shape[0]
    if whole > 1 and last[whole - 1] - last[whole - 2] != last[0]:
        whole -= 1  # samples left over, summed with a bias of their own
    for n in range(last.shape[0]):
        if n % chunk == 0 or n == whole:
            assumed[:] = s[BIAS : BIAS + 3]
        first = 0 if n == 0 else last[n - 1]
        _increment(step_s, rate_rad_s, force_m_s2, field_au, first, last[n], n, assumed, steps, work.force)
        if n == 0:
            _set_up(filt, limits, steps, work, pause_s)
        _about_up(s[HEADING], filt.level, steps.start[n])
        steps.start_bias[n] = s[NORTH_BIAS : NORTH_BIAS + 3] if limits.magnetic else s[BIAS : BIAS + 3]
        _advance(n, filt, limits, field_limits, steps, work)
        _about_up(s[HEADING], filt.level, steps.matrix[n])
        steps.velocity[n] = s[SPEED : SPEED + 3]
        steps.bias[n] = s[NORTH_BIAS : NORTH_BIAS + 3] if limits.magnetic else s[BIAS : BIAS + 3]
        for i in range(3):
            steps.sd_rad[n, i] = math.sqrt(filt.covariance[i, i])
        steps.resting[n], steps.disturbed[n] = s[RESTING], s[DISTURBED]
        steps.started[n] = 1.0 - s[STARTING]
        for i in range(SMOOTHED):
            steps.noise[n, i] = work.noise[i, i]
        if steps.covariance.shape[0] > 0:
            steps.covariance[n] = filt.covariance[:SMOOTHED, :SMOOTHED]
            steps.transition[n] = work.transition[:SMOOTHED, :SMOOTHED]


@njit(cache=True, nogil=True, error_model="numpy")
def _increment(
    step_s: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    field: FloatArray,
    first: int,
    last: int,
    n: int,
    assumed: FloatArray,
    steps: FilterSteps,
    velocity: FloatArray,
) -> None:
    """Sum the samples of one increment; `velocity` becomes the integral of the specific force."""
    turn = np.empty((3, 3))
    q = (0.0, 0.0, 0.0, 1.0)
    duration, fields = 0.0, 0
    velocity[:] = 0.0
    for i in range(3):
        steps.rate_rad_s[n, i] = steps.field_au[n, i] = 0.0
    for k in range(first, last):
        step = step_s[k]
        x, y, z = (rate[k, 0] - assumed[0]) * step, (rate[k, 1] - assumed[1]) * step, 0.0
        z = (rate[k, 2] - assumed[2]) * step
        q = multiplied(q, quaternion_of(x, y, z)) if k > first else quaternion_of(x, y, z)
        matrix_into(multiplied(q, quaternion_of(-0.5 * x, -0.5 * y, -0.5 * z)), turn)
        for i in range(3):
            velocity[i] += step * (
                turn[i, 0] * force[k, 0] + turn[i, 1] * force[k, 1] + turn[i, 2] * force[k, 2]
            )
            steps.rate_rad_s[n, i] += step * rate[k, i]
        matrix_into(q, turn)
        if math.isfinite(field[k, 0]) and math.isfinite(field[k, 1]) and math.isfinite(field[k, 2]):
            fields += 1
            for i in range(3):
                steps.field_au[n, i] += (
                    turn[i, 0] * field[k, 0] + turn[i, 1] * field[k, 1] + turn[i, 2] * field[k, 2]
                )
        duration += step
        steps.time_s[k] = duration
        for i in range(4):
            steps.turns_xyzw[k, i] = q[i]
    steps.duration_s[n] = duration
    steps.turn[n] = turn
    for i in range(3):
        steps.assumed_bias[n, i] = assumed[i]
        steps.rate_rad_s[n, i] /= duration
        steps.field_au[n, i] = steps.field_au[n, i] / fields if fields > 0 else math.nan


@njit(cache=True, nogil=True, error_model="numpy")
def _about_up(heading: float, level: FloatArray, out: FloatArray) -> None:
    c, s = math.cos(heading), math.sin(heading)
    for j in range(3):
        out[0, j] = c * level[0, j] - s * level[1, j]
        out[1, j] = s * level[0, j] + c * level[1, j]
        out[2, j] = level[2, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _upright(force: FloatArray, out: FloatArray) -> None:
    """Fill the shortest rotation that takes `force` to up."""
    norm = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    x, y, z = 0.0, 0.0, 1.0
    if norm > 0.0:
        x, y, z = force[0] / norm, force[1] / norm, force[2] / norm
    sine = math.sqrt(x * x + y * y)
    if sine < 1e-9:
        out[:] = 0.0
        out[0, 0], out[1, 1] = 1.0, math.copysign(1.0, z)
        out[2, 2] = math.copysign(1.0, z)
        return
    angle = math.atan2(sine, z)
    turn_into(y / sine * angle, -x / sine * angle, 0.0, out)


@njit(cache=True, nogil=True, error_model="numpy")
def _set_up(filt: FilterState, limits: FilterLimits, steps: FilterSteps, work: _Work, pause_s: float) -> None:
    """Begin before the first increment of a stretch: anew, or after a pause with the bias found so far."""
    s, p, fresh = filt.state, filt.covariance, filt.fresh
    if s[RUNNING] == 0.0:
        p[:] = fresh
        s[RUNNING] = 1.0
    else:
        walk = limits.bias_walk * limits.bias_walk * pause_s
        for i in range(SIZE):
            for j in range(SIZE):
                both = (3 <= i < 6 or 9 <= i < 12) and (3 <= j < 6 or 9 <= j < 12)
                if not both:
                    p[i, j] = fresh[i, j]
            if 3 <= i < 6 or 9 <= i < 12:
                p[i, i] += walk
    s[STRAY] = s[REST_KNOWN] = s[STILL] = s[START_S] = s[START_FIELD_S] = 0.0
    s[REST_FORCE : REST_FORCE + 3] = s[START_FORCE : START_FORCE + 3] = 0.0
    s[START_FIELD : START_FIELD + 3] = 0.0
    s[STARTING] = 1.0
    filt.start_turn[:] = np.eye(3)
    _upright(work.force, filt.level)
    s[HEADING] = 0.0
    if limits.magnetic and not math.isnan(steps.field_au[0, 0]):
        apply_into(filt.level, steps.field_au[0], work.field)
        s[HEADING] = -math.atan2(work.field[1], work.field[0])


@njit(cache=True, nogil=True, error_model="numpy")
def _rests(
    n: int, s: FloatArray, bias_sd: float, limits: FilterLimits, steps: FilterSteps, work: _Work
) -> bool:
    duration = steps.duration_s[n]
    share = duration / (limits.rest_memory_s + duration)
    if s[REST_KNOWN] == 0.0:
        s[REST_KNOWN] = 1.0
        for i in range(3):
            s[REST_RATE + i], s[REST_FORCE + i] = steps.rate_rad_s[n, i], work.force[i] / duration
    rate_off = force_off = bias_off = 0.0
    for i in range(3):
        off = steps.rate_rad_s[n, i] - s[REST_RATE + i]
        rate_off += off * off
        s[REST_RATE + i] += share * off
        off = work.force[i] / duration - s[REST_FORCE + i]
        force_off += off * off
        s[REST_FORCE + i] += share * off
        off = s[REST_RATE + i] - s[BIAS + i]
        bias_off += off * off
    still = (
        math.sqrt(rate_off) < limits.rest_rate_rad_s
        and math.sqrt(force_off) < limits.rest_force_m_s2
        and math.sqrt(bias_off) < limits.rest_bias_rad_s + 3.0 * bias_sd
    )
    s[STILL] = s[STILL] + duration if still else 0.0
    return bool(s[STILL] > limits.rest_after_s)


@njit(cache=True, nogil=True, error_model="numpy")
def _rate(n: int, s: FloatArray, steps: FilterSteps) -> float:
    total = 0.0
    for i in range(3):
        off = steps.rate_rad_s[n, i] - s[BIAS + i]
        total += off * off
    return math.sqrt(total)


@njit(cache=True, nogil=True, error_model="numpy")
def _advance(
    n: int,
    filt: FilterState,
    limits: FilterLimits,
    field_limits: FieldLimits,
    steps: FilterSteps,
    work: _Work,
) -> None:
    """Predict over one increment and correct by its observations."""
    s, p = filt.state, filt.covariance
    duration = steps.duration_s[n]
    bias_sd = math.sqrt(max(p[3, 3], p[4, 4], p[5, 5], 0.0))
    s[RESTING] = 1.0 if _rests(n, s, bias_sd, limits, steps, work) else 0.0
    work.before[:] = filt.level
    _predict(n, filt, limits, steps, work)
    steps.predicted[n] = filt.level
    steps.predicted_velocity[n] = s[SPEED : SPEED + 3]
    there = not math.isnan(steps.field_au[n, 0])
    if s[STARTING] > 0.0:
        _begin(n, filt, limits, field_limits, steps, work, there)
        return
    # A velocity of zero, whose error is a hand's, or smaller at rest, and persists.
    variance = (limits.rest_speed_variance if s[RESTING] > 0.0 else limits.speed_variance) / duration
    work.shows[:] = 0.0
    for i in range(3):
        work.shows[i, 6 + i] = 1.0
        work.residual[i] = -s[SPEED + i]
    work.rows_and_mask[0], work.rows_and_mask[1] = 3, 0
    _update(variance, filt, limits, work)
    if s[RESTING] > 0.0:
        _correct_bias(n, filt, limits, steps, work)
    if there and limits.magnetic:
        apply_into(work.before, steps.field_au[n], work.field)
        _correct_heading(n, filt, limits, field_limits, steps, work)


@njit(cache=True, nogil=True, error_model="numpy")
def _predict(n: int, filt: FilterState, limits: FilterLimits, steps: FilterSteps, work: _Work) -> None:
    s, p, level, f, q = filt.state, filt.covariance, filt.level, work.transition, work.noise
    duration, resting, magnetic = steps.duration_s[n], s[RESTING] > 0.0, limits.magnetic
    f[:] = 0.0
    for i in range(SIZE):
        f[i, i] = 1.0
    if not resting:
        f[12, 12] = 1.0 - duration / limits.field_place_s
        vx, vy, vz = s[SPEED], s[SPEED + 1], s[SPEED + 2]
        for j in range(3):
            x, y, z = level[0, j] * duration, level[1, j] * duration, level[2, j] * duration
            f[0, 3 + j], f[1, 3 + j] = -x, -y
            f[2, (9 if magnetic else 3) + j] = -z
            f[6, 3 + j], f[7, 3 + j], f[8, 3 + j] = vz * y - vy * z, vx * z - vz * x, vy * x - vx * y
    f[6, 1], f[7, 0] = limits.gravity_m_s2 * duration, -limits.gravity_m_s2 * duration
    _make_noise(duration, _rate(n, s, steps), resting, limits, q)
    wide = work.wide
    for i in range(SIZE):
        for j in range(SIZE):
            wide[i, j] = f[i, i] * p[i, j]
        for k in range(SIZE):
            factor = f[i, k]
            if k != i and factor != 0.0:
                for j in range(SIZE):
                    wide[i, j] += factor * p[k, j]
    for i in range(SIZE):
        for j in range(SIZE):
            total = q[i, j] + f[j, j] * wide[i, j]
            p[i, j] = total
    for j in range(SIZE):
        for k in range(SIZE):
            factor = f[j, k]
            if k != j and factor != 0.0:
                for i in range(SIZE):
                    p[i, j] += factor * wide[i, k]
    s[STRAY] *= f[12, 12]
    if magnetic:
        for i in range(3):
            s[HEADING] += level[2, i] * duration * (s[BIAS + i] - s[NORTH_BIAS + i])
    for i in range(3):
        s[SPEED + i] += (
            level[i, 0] * work.force[0] + level[i, 1] * work.force[1] + level[i, 2] * work.force[2]
        )
    s[SPEED + 2] -= limits.gravity_m_s2 * duration
    if not resting:
        product_into(level, steps.turn[n], level)
        turn_into(
            (steps.assumed_bias[n, 0] - s[BIAS]) * duration,
            (steps.assumed_bias[n, 1] - s[BIAS + 1]) * duration,
            (steps.assumed_bias[n, 2] - s[BIAS + 2]) * duration,
            work.a,
        )
        product_into(level, work.a, level)


@njit(cache=True, nogil=True, error_model="numpy")
def _make_noise(duration: float, rate: float, resting: bool, limits: FilterLimits, q: FloatArray) -> None:
    turning = limits.gyro_noise * limits.gyro_noise + (limits.gyro_scale_noise * rate) ** 2
    if resting:
        turning = (limits.rest_noise * limits.gyro_noise) ** 2
    walk = limits.bias_walk * limits.bias_walk * duration
    q[:] = 0.0
    for i in range(3):
        q[i, i] = turning * duration
        q[i + 3, i + 3] = walk
        q[i + 6, i + 6] = limits.force_noise * limits.force_noise * duration
        if limits.magnetic:
            q[i + 9, i + 9] = q[i + 3, i + 9] = q[i + 9, i + 3] = walk
    if limits.magnetic and not resting:
        q[12, 12] = 2.0 * limits.field_sd_rad * limits.field_sd_rad / limits.field_place_s * duration


@njit(cache=True, nogil=True, error_model="numpy")
def _begin(
    n: int,
    filt: FilterState,
    limits: FilterLimits,
    field_limits: FieldLimits,
    steps: FilterSteps,
    work: _Work,
    there: bool,
) -> None:
    """Set up from the mean force since the start, and north from the mean field."""
    s, turn = filt.state, filt.start_turn
    duration = steps.duration_s[n]
    for i in range(3):
        for j in range(3):
            s[START_FORCE + i] += turn[i, j] * work.force[j]
            if there:
                s[START_FIELD + i] += turn[i, j] * steps.field_au[n, j] * duration
    if there:
        s[START_FIELD_S] += duration
    product_into(turn, steps.turn[n], turn)
    s[START_S] += duration
    _upright(s[START_FORCE : START_FORCE + 3], work.a)
    product_into(work.a, turn, filt.level)
    s[SPEED : SPEED + 3] = 0.0
    over = s[START_S] >= limits.start_s
    s[STARTING] = 0.0 if over else 1.0
    if s[START_FIELD_S] > 0.0 and limits.magnetic:
        for i in range(3):
            work.clean[i] = 0.0
            for j in range(3):
                work.clean[i] += s[START_FIELD + j] * turn[j, i] / s[START_FIELD_S]
        apply_into(filt.level, work.clean, work.field)
        s[HEADING] = -math.atan2(work.field[1], work.field[0])
        if over:
            _correct_heading(n, filt, limits, field_limits, steps, work)


@njit(cache=True, nogil=True, error_model="numpy")
def _correct_bias(n: int, filt: FilterState, limits: FilterLimits, steps: FilterSteps, work: _Work) -> None:
    """Correct both copies of the bias, one by one, by the gyroscope's reading at rest."""
    s = filt.state
    variance = limits.rest_bias_variance / steps.duration_s[n]
    work.shows[:] = 0.0
    north = np.empty(3)
    for i in range(3):
        work.shows[i, 3 + i] = 1.0
        work.residual[i] = steps.rate_rad_s[n, i] - s[BIAS + i]
    if not limits.magnetic:
        work.rows_and_mask[0], work.rows_and_mask[1] = 3, 0
        _update(variance, filt, limits, work)
        return
    work.rows_and_mask[0], work.rows_and_mask[1] = 3, 1
    _update(variance, filt, limits, work)
    work.shows[:] = 0.0
    for i in range(3):
        north[i] = steps.rate_rad_s[n, i] - s[NORTH_BIAS + i]
        work.shows[i, 9 + i] = 1.0
        work.residual[i] = north[i]
    work.rows_and_mask[0], work.rows_and_mask[1] = 3, 2
    _update(variance, filt, limits, work)


@njit(cache=True, nogil=True, error_model="numpy")
def _correct_heading(
    n: int,
    filt: FilterState,
    limits: FilterLimits,
    field_limits: FieldLimits,
    steps: FilterSteps,
    work: _Work,
) -> None:
    """Correct the heading, and what belongs to it alone, by the field `work.field` in level axes."""
    s, p, duration = filt.state, filt.covariance, steps.duration_s[n]
    disturbed, variance, restarted = read_field(
        filt.monitor,
        filt.candidate,
        filt.known,
        field_limits,
        filt.level,
        work.field,
        _rate(n, s, steps),
        duration,
        work.clean,
        work.restart,
    )
    s[DISTURBED] = 1.0 if disturbed else 0.0
    if restarted:
        place = limits.field_sd_rad * limits.field_sd_rad
        residual = _wrapped(-math.atan2(work.restart[1], work.restart[0]) - s[HEADING] - s[STRAY])
        if residual * residual > 9.0 * (p[2, 2] + place):
            p[2, 2] += residual * residual
            work.shows[0] = 0.0
            work.shows[0, 2] = work.shows[0, 12] = 1.0
            work.residual[0] = residual
            work.rows_and_mask[0], work.rows_and_mask[1] = 1, 2
            _update(place, filt, limits, work)
    x, y, z = work.clean
    horizontal = x * x + y * y
    if disturbed or horizontal == 0.0:
        return
    work.shows[0] = 0.0
    work.shows[0, 0], work.shows[0, 1], work.shows[0, 2] = -z * x / horizontal, -z * y / horizontal, 1.0
    work.shows[0, 12] = 1.0
    work.residual[0] = _wrapped(-math.atan2(y, x) - s[HEADING] - s[STRAY])
    noise = limits.field_noise * limits.field_noise + 2.0 * limits.field_off_s * variance
    work.rows_and_mask[0], work.rows_and_mask[1] = 1, 2
    _update(noise / duration, filt, limits, work)


@njit(cache=True, nogil=True, error_model="numpy")
def _wrapped(angle: float) -> float:
    """Angle brought into [-pi, pi], as `math.remainder` does."""
    return float(angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi)))


@njit(cache=True, nogil=True, error_model="numpy")
def _update(variance: float, filt: FilterState, limits: FilterLimits, work: _Work) -> None:
    """Kalman's correction (Joseph's form) by `work.residual`, of which `work.shows` are the derivatives.

    `work.rows_and_mask` holds the number of rows and a mask: 1 leaves the states of the heading alone, 2 all
    others (Schmidt), whose errors count as noise.
    """
    p, shows, cross, wide = filt.covariance, work.shows, work.cross, work.wide
    rows, mask = work.rows_and_mask[0], work.rows_and_mask[1]
    gain = work.gain[:rows]
    for r in range(rows):
        cross[r] = 0.0
        for k in range(SIZE):
            factor = shows[r, k]
            if factor != 0.0:
                for j in range(SIZE):
                    cross[r, j] += factor * p[k, j]
    for r in range(rows):
        for t in range(rows):
            total = variance if r == t else 0.0
            for k in range(SIZE):
                total += cross[r, k] * shows[t, k]
            work.innovation[r, t] = total
        gain[r] = cross[r]
    solve_into(work.innovation, gain)
    if mask > 0:
        for j in range(SIZE):
            north = j == 2 or j >= 9
            if north != (mask == 2):
                for r in range(rows):
                    gain[r, j] = 0.0
    for i in range(SIZE):
        for j in range(SIZE):
            total = p[i, j]
            for r in range(rows):
                total -= gain[r, i] * cross[r, j]
            wide[i, j] = total
    for i in range(SIZE):
        for r in range(rows):
            total = -variance * gain[r, i]
            for k in range(SIZE):
                total += wide[i, k] * shows[r, k]
            cross[r, i] = total
    for i in range(SIZE):
        for j in range(SIZE):
            total = wide[i, j]
            for r in range(rows):
                total -= cross[r, i] * gain[r, j]
            p[i, j] = total
    _inject(filt, limits, work)


@njit(cache=True, nogil=True, error_model="numpy")
def _inject(filt: FilterState, limits: FilterLimits, work: _Work) -> None:
    """Apply the estimated error to the state."""
    s = filt.state
    error = np.zeros(SIZE)
    for j in range(SIZE):
        for r in range(work.rows_and_mask[0]):
            error[j] += work.gain[r, j] * work.residual[r]
    if limits.magnetic:
        s[HEADING] = _wrapped(s[HEADING] + error[2])
        error[2] = 0.0
    turn_into(error[0], error[1], error[2], work.a)
    product_into(work.a, filt.level, filt.level)
    apply_into(work.a, s[SPEED : SPEED + 3], s[SPEED : SPEED + 3])
    for i in range(3):
        s[SPEED + i] += error[6 + i]
        s[BIAS + i] += error[3 + i]
        s[NORTH_BIAS + i] += error[9 + i]
    s[STRAY] += error[12]
