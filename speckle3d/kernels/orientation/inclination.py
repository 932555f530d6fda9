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
from speckle3d.kernels.orientation.rotations import (
    Quaternion,
    add_product,
    compiled,
    inverse,
    invert,
    matrix_product,
    norm,
    product,
    quaternion,
    quaternion_of,
    rotate,
    subtract_product,
    three,
    transported,
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
    s, step, f, n = filters[0], partial[0], np.zeros((SIZE, SIZE)), 0
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
                covariance[n], transition[n] = s.p, f
            step.last = k + 1
            steps[n] = partial[0]
            n += 1
            _open(s, step)
        level = quaternion(s.level)
        xyzw[k] = level if s.resting else product(level, quaternion(step.turn))
    return n


@compiled
def _open(s: Any, step: Any) -> None:
    """Begin an increment."""
    step.duration_s = step.fields = step.lost_rad2 = 0.0
    step.rate[:], step.field[:], step.force[:], step.turn[:] = 0.0, 0.0, 0.0, _NO_TURN
    step.start[:], step.start_bias[:] = s.level, s.bias


@compiled
def _add(step: Any, dt: float, rate: FloatArray, force: FloatArray, field: FloatArray) -> None:
    """Add a sample to an increment, with the increment's bias."""
    half = turn_by(rate, step.start_bias, 0.5 * dt)
    q = product(quaternion(step.turn), half)
    for i, part in enumerate(rotate(q, three(force))):
        step.force[i] += dt * part
        step.rate[i] += dt * rate[i]
    q = product(q, half)
    if math.isfinite(field[0] + field[1] + field[2]):
        for i, part in enumerate(rotate(q, three(field))):
            step.field[i] += part
        step.fields += 1.0
    step.turn[:] = q
    step.duration_s += dt


@compiled
def _complete(s: Any, step: Any, f: FloatArray) -> None:
    """Predict over an increment, and correct; fill what it leaves behind, and its transition."""
    step.rate /= step.duration_s
    step.field /= step.fields if step.fields > 0.0 else math.nan
    _predict(s, step, f)
    if s.starting:
        _begin(s, step)
    else:
        _correct_by_speed(s, step)
        if s.resting:
            gain = _correct(s.p, BIAS, _REST_BIAS_RAD**2 / step.duration_s, _LEVEL)
            _inject(s, gain, step.rate - s.bias)
    step.level[:], step.speed[:], step.bias[:] = s.level, s.speed, s.bias
    step.resting, step.started = s.resting, not s.starting
    for i in range(6):
        step.sd[i] = math.sqrt(s.p[i, i])
    if s.starting and s.still_s < s.start_s:
        step.sd[:2] = step.sd[:2] * min(max(_START_S / s.start_s, 1.0), _LARGEST_START)


@compiled
def _upright(force: FloatArray) -> Quaternion:
    """The shortest rotation that takes a force to up."""
    size = norm(force)
    if size == 0.0 or force[2] < -0.999999 * size:
        return (0.0, 0.0, 0.0, 1.0) if size == 0.0 else (1.0, 0.0, 0.0, 0.0)
    x, y, w = force[1] / size, -force[0] / size, 1.0 + force[2] / size
    length = math.sqrt(x * x + y * y + w * w)
    return x / length, y / length, 0.0, w / length


@compiled
def _set_up(s: Any, force: FloatArray) -> None:
    """Begin before the first sample: anew, or after a pause with the bias found so far."""
    bias_variance = s.p[BIAS : BIAS + 3, BIAS : BIAS + 3].copy()
    s.p[:] = np.diag(s.fresh)
    if s.running:
        walk = _BIAS_WALK_RAD_S_SQRT_S**2 * s.pause_s
        s.p[BIAS : BIAS + 3, BIAS : BIAS + 3] = bias_variance + walk * np.eye(3)
    s.running = s.starting = True
    s.resting = s.rest_known = False
    s.still_s = s.start_s = 0.0
    s.pause_s = -1.0
    s.start_force[:], s.speed[:] = 0.0, 0.0
    s.level[:] = _upright(force)
    s.start_turn[:] = s.level  # in level axes: those of a sensor upside down would turn with every reading


@compiled
def _begin(s: Any, step: Any) -> None:
    """Set up from the mean force since the start."""
    turn = quaternion(s.start_turn)
    s.start_force += np.array(rotate(turn, three(step.force)))
    turn = product(turn, quaternion(step.turn))
    s.start_turn[:] = turn
    s.start_s += step.duration_s
    s.level[:] = product(_upright(s.start_force), turn)
    s.speed[:] = 0.0
    s.starting = s.start_s < (_START_S if s.still_s > 0.5 * _START_S else _MOVING_START_S)


@compiled
def _rest(s: Any, step: Any) -> None:
    """Note whether the sensor rests."""
    force = step.force / step.duration_s
    if not s.rest_known:
        s.rest_rate[:], s.rest_force[:], s.rest_known = step.rate, force, True
    rate_off, force_off = step.rate - s.rest_rate, force - s.rest_force
    share = step.duration_s / (_REST_MEMORY_S + step.duration_s)
    s.rest_rate[:] = s.rest_rate + share * rate_off
    s.rest_force[:] = s.rest_force + share * force_off
    bias_sd = math.sqrt(max(s.p[3, 3], s.p[4, 4], s.p[5, 5], 0.0))
    still = (
        norm(rate_off) < _STILL_RAD_S
        and norm(force_off) < _STILL_M_S2
        and norm(s.rest_rate - s.bias) < _STILL_BIAS_RAD_S + 3.0 * bias_sd
    )
    s.still_s = s.still_s + step.duration_s if still else 0.0
    s.resting = s.still_s > _STILL_S


@compiled
def _predict(s: Any, step: Any, f: FloatArray) -> None:
    """Predict over one increment; fill its transition."""
    _rest(s, step)
    level, duration = quaternion(s.level), step.duration_s
    f[:] = np.eye(SIZE)
    span = 0.0 if s.resting else duration
    for j in range(3):
        x, y, z = rotate(level, three(_AXES[j]))
        u, v, w = three(s.speed)
        f[0, BIAS + j], f[1, BIAS + j], f[2, BIAS + j] = -span * x, -span * y, -span * z
        f[SPEED, BIAS + j], f[SPEED + 1, BIAS + j] = span * (y * w - z * v), span * (z * u - x * w)
        f[SPEED + 2, BIAS + j] = span * (x * v - y * u)
    f[6, 1], f[7, 0] = GRAVITY_M_S2 * duration, -GRAVITY_M_S2 * duration
    shock = max(norm(step.force) - _SHOCK_M_S2 * duration, 0.0)  # a knock, whose reading may be cut off
    noise = _GYRO_NOISE_RAD_SQRT_S**2 + (s.scale_noise_sqrt_s * norm(step.rate - s.bias)) ** 2
    if s.resting:
        noise = (_REST_NOISE * _GYRO_NOISE_RAD_SQRT_S) ** 2
    step.noise[:3] = noise * duration + step.lost_rad2
    step.noise[3:6] = _BIAS_WALK_RAD_S_SQRT_S**2 * duration
    step.noise[6:] = _FORCE_NOISE_M_S_SQRT_S**2 * duration + shock**2
    s.p[:] = transported(f, s.p)
    for i in range(SIZE):
        s.p[i, i] += step.noise[i]
    s.speed += np.array(rotate(level, three(step.force)))
    s.speed[2] -= GRAVITY_M_S2 * duration
    if not s.resting:
        s.level[:] = product(level, quaternion(step.turn))
    step.predicted[:], step.predicted_speed[:] = s.level, s.speed


@compiled
def _correct_by_speed(s: Any, step: Any) -> None:
    """Correct by a velocity of zero, whose error is a hand's, or smaller at rest, and persists.

    A velocity tells nothing of turning about up: its own direction turns as likely. So neither heading nor
    the bias about up is corrected by it, and their errors count as noise (Schmidt).
    """
    speed, time_s = (_REST_SPEED_M_S, _REST_TIME_S) if s.resting else (SPEED_M_S, _SPEED_TIME_S)
    up = np.array(rotate(invert(quaternion(s.level)), (0.0, 0.0, 1.0)))
    gain = _correct(s.p, SPEED, 2.0 * speed**2 * time_s / step.duration_s, up)
    _inject(s, gain, -s.speed)


_LEVEL, _AXES, _NO_TURN = np.zeros(3), np.eye(3), np.array([0.0, 0.0, 0.0, 1.0])


@compiled
def _correct(p: FloatArray, first: int, variance: float, up: FloatArray) -> FloatArray:
    """Correct a covariance by an observation of three states; return the gain, shape (9, 3).

    The heading is found elsewhere, and corrected by nothing; nor is the bias about `up`.
    """
    cross = p[:, first : first + 3].copy()
    total = cross[first : first + 3].copy()
    for i in range(3):
        total[i, i] += variance
    gain = matrix_product(cross, inverse(total)[0])
    gain[2] = 0.0
    for j in range(3):
        about_up = up[0] * gain[3, j] + up[1] * gain[4, j] + up[2] * gain[5, j]
        for i in range(3):
            gain[3 + i, j] -= about_up * up[i]
    subtract_product(p, gain, cross)
    subtract_product(p, p[:, first : first + 3] - variance * gain, gain)
    return gain


@compiled
def _inject(s: Any, gain: FloatArray, off: FloatArray) -> None:
    """Apply the estimated error to the state."""
    error = np.zeros(SIZE)
    add_product(error, gain, off)
    turn = quaternion_of(error[0], error[1], error[2])
    s.level[:] = product(turn, quaternion(s.level))
    s.speed[:] = rotate(turn, three(s.speed))
    s.speed[:] = s.speed + error[SPEED:]
    s.bias[:] = s.bias + error[BIAS:SPEED]
