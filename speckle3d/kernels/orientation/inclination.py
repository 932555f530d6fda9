"""Inclination and turning over a stretch of samples: an error-state Kalman filter by short increments.

The accelerometer is integrated to velocity, which stays near zero in a hand: over many swings that shows the
direction of gravity in spite of movement, where the accelerometer itself shows it only at rest. The attitude
error is the invariant one (velocity turns with it), so that errors of heading and velocity stay separate. The
magnetometer has no part in it: it cannot tilt the orientation; `heading` beside this turns that to north.

An increment sums the turn and the turned specific force of its samples, each with the attitude in the middle
of the sample's interval, so that the filter may run more slowly than the sensor without losing coning and
sculling motion [4]_.

References
----------
.. [1] F. L. Markley, "Attitude error representations for Kalman filtering", J. Guid. Control Dyn., 2003.
.. [2] A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE TAC, 2017.
.. [3] D. Laidig, T. Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation and magnetic
   disturbance rejection", Information Fusion, 2023 (rest detection; inclination and heading apart).
.. [4] P. G. Savage, "Strapdown inertial navigation integration algorithm design", J. Guid. Control
   Dyn., 1998.
"""

import math
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.copying import copy_into
from speckle3d.kernels.orientation.rotations import (
    AXES,
    Quaternion,
    add_product,
    compiled,
    difference,
    for_kernels,
    inverse,
    invert,
    norm,
    product,
    quaternion,
    quaternion_of,
    rotate,
    store,
    subtract_product,
    three,
    times_transpose,
    turn_by,
)

ATTITUDE, BIAS, SPEED, SIZE = 0, 3, 6, 9
"""Places in the error state: attitude (world axes), gyroscope bias (sensor axes), velocity (world axes)."""

FILTER = np.dtype(
    [
        ("pause_s", "f8"),  # before the next sample, after which up is found anew; negative if it goes on
        ("running", "?"),
        ("starting", "?"),
        ("resting", "?"),
        ("level", "f8", 4),  # world from sensor
        ("bias", "f8", 3),
        ("speed", "f8", 3),
        ("p", "f8", (SIZE, SIZE)),
        ("fresh", "f8", SIZE),  # variances at a start
        ("scale_noise_sqrt_s", "f8"),  # error of the gyroscope's scale and axes, a fraction of the turn
        ("rest_known", "?"),
        ("rest_rate", "f8", 3),  # means of lately
        ("rest_force", "f8", 3),
        ("still_s", "f8"),
        ("start_s", "f8"),
        ("start_force", "f8", 3),  # sum since the start, in its first axes
        ("start_turn", "f8", 4),  # those axes from the present ones
    ],
    align=True,
)
"""What is kept from one increment to the next, and from one stretch to the next."""

STEP = np.dtype(
    [
        ("duration_s", "f8"),
        ("rate", "f8", 3),  # mean reading of the gyroscope
        ("field", "f8", 3),  # mean, in the axes at the start; NaN where there is none
        ("fields", "f8"),  # how many readings that is of
        ("force", "f8", 3),  # integral of the specific force, likewise
        ("turn", "f8", 4),  # start from end
        ("lost_rad2", "f8"),  # variance of the turn over lost samples
        ("start", "f8", 4),  # world from sensor before the increment,
        ("start_bias", "f8", 3),  # with which its turns are summed,
        ("predicted", "f8", 4),  # after it,
        ("predicted_speed", "f8", 3),
        ("level", "f8", 4),  # and after its correction
        ("speed", "f8", 3),
        ("bias", "f8", 3),
        ("noise", "f8", SIZE),  # diagonal
        ("sd", "f8", 6),  # of attitude and bias
        ("north", "f8", 5),  # filled by the heading's filters, as `xsens.fusion.heading.UNKNOWN` has it
        ("last", "i8"),  # sample after its last one
        ("resting", "?"),
        ("started", "?"),
    ],
    align=True,
)
"""One increment, and the filter before and after it."""

BLOCK_S = 1.0 / 32.0
"""Length of the increments: short against hand movement (tremor is below 12 Hz)."""

GRAVITY_M_S2 = 9.80665
"""Standard gravity; local gravity differs by 0.3 % at most and an accelerometer by more."""

_GYRO_NOISE_RAD_SQRT_S = math.radians(0.05)
"""Angle random walk: an MT9-B's Allan deviation at 1 s. Newer sensors have a tenth."""

_BIAS_WALK_RAD_S_SQRT_S = math.radians(0.002)
"""Random walk of the bias: 0.05 deg/s in ten minutes."""

SPEED_M_S, _SPEED_TIME_S = 0.5, 0.5
"""Standard deviation of a hand's speed about its mean, zero, and how long a speed persists."""

_FORCE_NOISE_M_S_SQRT_S = 0.01
"""Velocity random walk of the accelerometer, misalignment in quick movement included."""

_STILL_RAD_S, _STILL_M_S2, _STILL_S = math.radians(1.0), 0.3, 1.5
"""A sensor rests if for the last of these neither reading is farther from its mean of half a second."""

_STILL_BIAS_RAD_S = math.radians(0.2)
"""A resting sensor's rate differs from the bias by no more (beyond 3 sd of the bias): slower, steady turning
is taken for bias."""

_SHOCK_M_S2 = 60.0
"""Mean force of an increment beyond which it is not believed: a board shaken by hand in BROAD reads 51."""

_START_S, _MOVING_START_S, _LARGEST_START = 1.0, 3.0, 3.0
"""Inclination at the start is that of the mean force over this time, at rest and in movement. A hand's speed
over a shorter time is a larger acceleration: so many times the error, up to 17 degrees (3 m/s^2)."""

_REST_SPEED_M_S, _REST_TIME_S = 0.02, 0.5
"""Standard deviation of a resting sensor's velocity, and how long the accelerometer's error persists."""

_REST_BIAS_RAD = math.radians(0.03)
"""Error of the bias after one second of rest: an MT9-B's Allan deviation at 1 s is 0.05 deg/s."""

_REST_NOISE = 0.1
"""Random walk of a resting sensor's attitude, as a fraction of the gyroscope's. The gyroscope is not
integrated at rest; this allows for turning too slow to notice."""

_REST_MEMORY_S = 0.5
"""Time over which a resting sensor's readings are averaged."""


@compiled
def run_filter(
    step_s: FloatArray,
    rate_rad_s: FloatArray,
    force_m_s2: FloatArray,
    field_au: FloatArray,
    lost_rad2: FloatArray,
    to_end: bool,
    filters: Any,
    partial: Any,
    steps: Any,
    covariance: FloatArray,
    transition: FloatArray,
    xyzw: FloatArray,
) -> int:
    """Run the filter over samples; return how many increments they complete.

    Parameters
    ----------
    step_s : ndarray, shape (m,)
    rate_rad_s, force_m_s2, field_au : ndarray, shape (m, 3)
    lost_rad2 : ndarray, shape (m,)
        Variance of the turn over lost readings before each sample.
    to_end : bool
        The last sample completes an increment, however short.
    filters : structured ndarray, shape (1,), of `FILTER`
        Changed in place.
    unfinished : structured ndarray, shape (1,), of `STEP`
        The increment that is not complete, from one call to the next.
    steps : structured ndarray, shape (n,), of `STEP`
        Filled, as many as are completed, as are the following.
    covariance, transition : ndarray, shape (n, 9, 9), or (0, 9, 9) if they are not wanted
    xyzw : ndarray, shape (m, 4)
        Level axes from the sensor's at every sample, by what came before it.
    """
    s, step, f, n = filters[0], partial[0], np.eye(SIZE), 0
    for k in range(step_s.shape[0]):
        if s.pause_s >= 0.0:
            _set_up(s, force_m_s2[k])
            _open(s, step)
        _add(step, step_s[k], rate_rad_s[k], force_m_s2[k], field_au[k])
        step.lost_rad2 += lost_rad2[k]
        whole = step.duration_s + 0.5 * step_s[k] >= BLOCK_S or (to_end and k == step_s.shape[0] - 1)
        if whole:
            _complete(s, step, f)
            if covariance.shape[0] > 0:
                copy_into(covariance[n], s.p)
                copy_into(transition[n], f)
            step.last = k + 1
            steps[n] = partial[0]
            n += 1
            _open(s, step)
        level = quaternion(s.level)
        store(level if s.resting else product(level, quaternion(step.turn)), xyzw[k])
    return n


@for_kernels
def _open(s: Any, step: Any) -> None:
    """Begin an increment."""
    step.duration_s = step.fields = step.lost_rad2 = 0.0
    for part in (step.rate, step.field, step.force):
        store(_NONE, part)
    store(_NO_TURN, step.turn)
    store(s.level, step.start)
    store(s.bias, step.start_bias)


@for_kernels
def _add(step: Any, dt: float, rate: FloatArray, force: FloatArray, field: FloatArray) -> None:
    """Add a sample to an increment, with the increment's bias."""
    half = turn_by(rate, step.start_bias, 0.5 * dt)
    q = product(quaternion(step.turn), half)
    part = rotate(q, three(force))
    for i in range(3):
        step.force[i] += dt * part[i]
        step.rate[i] += dt * rate[i]
    q = product(q, half)
    if math.isfinite(field[0] + field[1] + field[2]):
        part = rotate(q, three(field))
        for i in range(3):
            step.field[i] += part[i]
        step.fields += 1.0
    store(q, step.turn)
    step.duration_s += dt


@for_kernels
def _complete(s: Any, step: Any, f: FloatArray) -> None:
    """Predict over an increment, and correct; fill what it leaves behind, and its transition."""
    for i in range(3):
        step.rate[i] /= step.duration_s
        step.field[i] /= step.fields
    _predict(s, step, f)
    if s.starting:
        _begin(s, step)
    else:
        _correct(s, step, SPEED)
        if s.resting:
            _correct(s, step, BIAS)
    store(s.level, step.level)
    store(s.speed, step.speed)
    store(s.bias, step.bias)
    step.resting, step.started = s.resting, not s.starting
    for i in range(6):
        step.sd[i] = math.sqrt(s.p[i, i])
    if s.starting and s.still_s < s.start_s:
        for i in range(2):
            step.sd[i] *= min(max(_START_S / s.start_s, 1.0), _LARGEST_START)


@for_kernels
def _upright(force: FloatArray) -> Quaternion:
    """The shortest rotation that takes a force to up."""
    size = norm(force)
    if size == 0.0 or force[2] < -0.999999 * size:
        return (0.0, 0.0, 0.0, 1.0) if size == 0.0 else (1.0, 0.0, 0.0, 0.0)
    x, y, w = force[1] / size, -force[0] / size, 1.0 + force[2] / size
    length = math.sqrt(x * x + y * y + w * w)
    return x / length, y / length, 0.0, w / length


@for_kernels
def _set_up(s: Any, force: FloatArray) -> None:
    """Begin before the first sample: anew, or after a pause with the bias found so far."""
    walk = _BIAS_WALK_RAD_S_SQRT_S**2 * s.pause_s
    for i in range(SIZE):
        for j in range(SIZE):
            if s.running and min(i, j) >= BIAS and max(i, j) < SPEED:
                s.p[i, j] += walk if i == j else 0.0
            else:
                s.p[i, j] = s.fresh[i] if i == j else 0.0
    s.running = s.starting = True
    s.resting = s.rest_known = False
    s.still_s = s.start_s = 0.0
    s.pause_s = -1.0
    store(_NONE, s.start_force)
    store(_NONE, s.speed)
    store(_upright(force), s.level)
    store(s.level, s.start_turn)  # in level axes: those of a sensor upside down would turn with every reading


@for_kernels
def _begin(s: Any, step: Any) -> None:
    """Set up from the mean force since the start."""
    turn = quaternion(s.start_turn)
    part = rotate(turn, three(step.force))
    for i in range(3):
        s.start_force[i] += part[i]
    turn = product(turn, quaternion(step.turn))
    store(turn, s.start_turn)
    s.start_s += step.duration_s
    store(product(_upright(s.start_force), turn), s.level)
    store(_NONE, s.speed)
    s.starting = s.start_s < (_START_S if s.still_s > 0.5 * _START_S else _MOVING_START_S)


@for_kernels
def _rest(s: Any, step: Any) -> None:
    """Note whether the sensor rests."""
    x, y, z = three(step.force)
    force = x / step.duration_s, y / step.duration_s, z / step.duration_s
    if not s.rest_known:
        store(step.rate, s.rest_rate)
        store(force, s.rest_force)
        s.rest_known = True
    rate_off, force_off = difference(step.rate, s.rest_rate), difference(force, s.rest_force)
    share = step.duration_s / (_REST_MEMORY_S + step.duration_s)
    for i in range(3):
        s.rest_rate[i] += share * rate_off[i]
        s.rest_force[i] += share * force_off[i]
    bias_sd = math.sqrt(max(s.p[3, 3], s.p[4, 4], s.p[5, 5], 0.0))
    still = (
        norm(rate_off) < _STILL_RAD_S
        and norm(force_off) < _STILL_M_S2
        and norm(difference(s.rest_rate, s.bias)) < _STILL_BIAS_RAD_S + 3.0 * bias_sd
    )
    s.still_s = s.still_s + step.duration_s if still else 0.0
    s.resting = s.still_s > _STILL_S


@for_kernels
def _predict(s: Any, step: Any, f: FloatArray) -> None:
    """Predict over one increment; fill its transition."""
    _rest(s, step)
    level, duration = quaternion(s.level), step.duration_s
    span = 0.0 if s.resting else duration
    for j in range(3):
        x, y, z = rotate(level, AXES[j])
        u, v, w = three(s.speed)
        f[0, BIAS + j], f[1, BIAS + j], f[2, BIAS + j] = -span * x, -span * y, -span * z
        f[SPEED, BIAS + j], f[SPEED + 1, BIAS + j] = span * (y * w - z * v), span * (z * u - x * w)
        f[SPEED + 2, BIAS + j] = span * (x * v - y * u)
    f[6, 1], f[7, 0] = GRAVITY_M_S2 * duration, -GRAVITY_M_S2 * duration
    shock = max(norm(step.force) - _SHOCK_M_S2 * duration, 0.0)  # a knock, whose reading may be cut off
    noise = _GYRO_NOISE_RAD_SQRT_S**2 + (s.scale_noise_sqrt_s * norm(difference(step.rate, s.bias))) ** 2
    if s.resting:
        noise = (_REST_NOISE * _GYRO_NOISE_RAD_SQRT_S) ** 2
    for i in range(3):
        step.noise[i] = noise * duration + step.lost_rad2
        step.noise[BIAS + i] = _BIAS_WALK_RAD_S_SQRT_S**2 * duration
        step.noise[SPEED + i] = _FORCE_NOISE_M_S_SQRT_S**2 * duration + shock**2
    copy_into(s.p, times_transpose(f, times_transpose(f, s.p)))
    part = rotate(level, three(step.force))
    for i in range(SIZE):
        s.p[i, i] += step.noise[i]
    for i in range(3):
        s.speed[i] += part[i]
    s.speed[2] -= GRAVITY_M_S2 * duration
    if not s.resting:
        store(product(level, quaternion(step.turn)), s.level)
    store(s.level, step.predicted)
    store(s.speed, step.predicted_speed)


_NONE, _NO_TURN = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


@for_kernels
def _correct(s: Any, step: Any, first: int) -> None:
    """Correct by a velocity of zero, or a resting sensor's bias by its rate.

    A velocity's error is a hand's, or smaller at rest, and persists. It tells nothing of turning about up:
    its own direction turns as likely. So the bias about up is not corrected by it, nor the heading by either,
    which is found elsewhere; their errors count as noise (Schmidt).
    """
    if first == SPEED:
        speed, time_s = (_REST_SPEED_M_S, _REST_TIME_S) if s.resting else (SPEED_M_S, _SPEED_TIME_S)
        variance, off = 2.0 * speed**2 * time_s / step.duration_s, difference(_NONE, s.speed)
        up = rotate(invert(quaternion(s.level)), AXES[2])
    else:
        variance, off = _REST_BIAS_RAD**2 / step.duration_s, difference(step.rate, s.bias)
        up = _NONE
    cross, error = np.empty((SIZE, 3)), np.zeros(SIZE)
    for i in range(SIZE):
        for j in range(3):
            cross[i, j] = s.p[i, first + j]
    gain = times_transpose(cross, inverse(cross[first : first + 3], variance)[0])
    for j in range(3):
        gain[2, j] = 0.0
        about_up = up[0] * gain[3, j] + up[1] * gain[4, j] + up[2] * gain[5, j]
        for i in range(3):
            gain[BIAS + i, j] -= about_up * up[i]
    subtract_product(s.p, gain, cross)
    for i in range(SIZE):
        for j in range(3):
            cross[i, j] = s.p[i, first + j] - variance * gain[i, j]
    subtract_product(s.p, cross, gain)
    add_product(error, gain, off)
    turn = quaternion_of(error[0], error[1], error[2])
    store(product(turn, quaternion(s.level)), s.level)
    store(rotate(turn, three(s.speed)), s.speed)
    for i in range(3):
        s.bias[i] += error[BIAS + i]
        s.speed[i] += error[SPEED + i]
