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
.. [5] H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA
   J., 1965.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation.rotations import (
    Quaternion,
    Vector,
    inverse,
    inverted,
    product,
    quaternion,
    quaternion_of,
    rotated,
    vector_of,
)

ATTITUDE, BIAS, SPEED, SIZE = 0, 3, 6, 9
"""Places in the error state: attitude (world axes), gyroscope bias (sensor axes), velocity (world axes)."""

LIMITS = np.dtype(
    [
        (name, "f8")
        for name in (
            "gravity_m_s2",
            "gyro_noise_rad_sqrt_s",
            "gyro_scale_noise_sqrt_s",
            "bias_walk_rad_s_sqrt_s",
            "speed_m_s",
            "speed_time_s",
            "force_noise_m_s_sqrt_s",
            "rest_rate_rad_s",
            "rest_force_m_s2",
            "rest_after_s",
            "rest_bias_rad_s",
        )
    ]
)
"""Settings of the filter, as `xsens.fusion.settings` explains them."""

FILTER = np.dtype(
    [
        ("running", "?"),
        ("starting", "?"),
        ("resting", "?"),
        ("level", "f8", 4),  # world from sensor
        ("bias", "f8", 3),
        ("speed", "f8", 3),
        ("p", "f8", (SIZE, SIZE)),
        ("fresh", "f8", SIZE),  # variances at a start
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
        ("resting", "?"),
        ("started", "?"),
    ],
    align=True,
)
"""One increment, and the filter before and after it."""

GOES_ON = -1.0
"""Pause before a stretch that is none: the stretch goes on from the last one."""

_SHOCK_M_S2 = 60.0
"""Mean force of an increment beyond which it is not believed: a board shaken by hand in BROAD reads 51."""

_START_S, _MOVING_START_S = 1.0, 3.0
"""Inclination at the start is that of the mean force over this time, at rest and in movement."""

_REST_SPEED_M_S, _REST_TIME_S = 0.02, 0.5
"""Standard deviation of a resting sensor's velocity, and how long the accelerometer's error persists."""

_REST_BIAS_RAD = math.radians(0.03)
"""Error of the bias after one second of rest: an MT9-B's Allan deviation at 1 s is 0.05 deg/s."""

_REST_NOISE = 0.1
"""Random walk of a resting sensor's attitude, as a fraction of the gyroscope's. The gyroscope is not
integrated at rest; this allows for turning too slow to notice."""

_REST_MEMORY_S = 0.5
"""Time over which a resting sensor's readings are averaged."""


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _three(v: FloatArray) -> Vector:
    return v[0], v[1], v[2]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _norm(v: FloatArray) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def run_filter(
    step_s: FloatArray,
    rate_rad_s: FloatArray,
    force_m_s2: FloatArray,
    field_au: FloatArray,
    lost_rad2: FloatArray,
    last: IntArray,
    pause_s: float,
    filters: Any,
    limits: Any,
    steps: Any,
    covariance: FloatArray,
    transition: FloatArray,
) -> None:
    """Run the filter over a stretch.

    Parameters
    ----------
    step_s : ndarray, shape (m,)
    rate_rad_s, force_m_s2, field_au : ndarray, shape (m, 3)
    lost_rad2 : ndarray, shape (m,)
        Variance of the turn over lost readings before each sample.
    last : ndarray of int, shape (n,)
        Sample after each increment's last.
    pause_s : float
        Time since the stretch before, at whose end the filter is; `GOES_ON` if there was no pause.
    filters, limits : structured ndarray, shape (1,), of `FILTER` and `LIMITS`
        The filter is changed in place.
    steps : structured ndarray, shape (n,), of `STEP`
        Filled.
    covariance, transition : ndarray, shape (n, 9, 9), or (0, 9, 9) if they are not wanted
        Filled.
    """
    s, r, f = filters[0], limits[0], np.zeros((SIZE, SIZE))
    first = 0
    for n in range(last.shape[0]):
        step = steps[n]
        step.start_bias[:] = s.bias
        _sum_samples(step_s, rate_rad_s, force_m_s2, field_au, first, last[n], step)
        step.lost_rad2 = lost_rad2[first : last[n]].sum()
        first = last[n]
        if n == 0 and pause_s != GOES_ON:
            _set_up(s, r, step, pause_s)
        step.start[:] = s.level
        _predict(s, r, step, f)
        if s.starting:
            _begin(s, step)
        else:
            _correct_by_speed(s, r, step)
            if s.resting:
                off = step.rate - s.bias
                gain = _correct(s.p, BIAS, _REST_BIAS_RAD**2 / step.duration_s, _LEVEL)
                _inject(s, gain @ off)
        step.level[:], step.speed[:], step.bias[:] = s.level, s.speed, s.bias
        step.resting, step.started = s.resting, not s.starting
        for i in range(6):
            step.sd[i] = math.sqrt(s.p[i, i])
        if covariance.shape[0] > 0:
            covariance[n], transition[n] = s.p, f


# -- increments


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _sum_samples(
    step_s: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    field: FloatArray,
    first: int,
    last: int,
    step: Any,
) -> None:
    """Sum the samples from `first` to before `last`, with the step's bias."""
    q = (0.0, 0.0, 0.0, 1.0)
    step.duration_s = 0.0
    step.rate[:], step.field[:], step.force[:] = 0.0, 0.0, 0.0
    fields = 0
    for k in range(first, last):
        dt = step_s[k]
        for i in range(3):
            step.rate[i] += dt * rate[k, i]
        half = _turn(rate[k], step.start_bias, 0.5 * dt)
        q = product(q, half)
        x, y, z = rotated(q, (force[k, 0], force[k, 1], force[k, 2]))
        step.force[0] += dt * x
        step.force[1] += dt * y
        step.force[2] += dt * z
        q = product(q, half)
        if math.isfinite(field[k, 0] + field[k, 1] + field[k, 2]):
            x, y, z = rotated(q, (field[k, 0], field[k, 1], field[k, 2]))
            step.field[0] += x
            step.field[1] += y
            step.field[2] += z
            fields += 1
        step.duration_s += dt
    step.turn[:] = q
    for i in range(3):
        step.rate[i] /= step.duration_s
        step.field[i] = step.field[i] / fields if fields > 0 else math.nan


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _turn(rate: FloatArray, bias: FloatArray, span_s: float) -> Quaternion:
    """Turn by a reading of the gyroscope over some time."""
    x, y, z = rate[0] - bias[0], rate[1] - bias[1], rate[2] - bias[2]
    return quaternion_of(x * span_s, y * span_s, z * span_s)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def orient_samples(
    step_s: FloatArray,
    rate_rad_s: FloatArray,
    last: IntArray,
    resting: FloatArray,
    starts: FloatArray,
    biases: FloatArray,
    ends: FloatArray,
    xyzw: FloatArray,
) -> None:
    """Fill the orientation of every sample, by the gyroscope from the start of its step.

    Parameters
    ----------
    step_s, rate_rad_s : ndarray, shapes (m,) and (m, 3)
    last, resting : ndarray, shape (n,)
        Sample after each step's last; whether the sensor stays at its step's start.
    starts, biases : ndarray, shapes (n, 4) and (n, 3)
        At the start of each step.
    ends : ndarray, shape (n, 4) or (0, 4)
        At the end of each step: the error there is spread over the step. Empty: it is left.
    xyzw : ndarray, shape (m, 4)
    """
    first = 0
    for n in range(last.shape[0]):
        q, whole_s, span_s = quaternion(starts[n]), 0.0, 0.0
        for k in range(first, last[n]):
            if not resting[n]:
                q = product(q, _turn(rate_rad_s[k], biases[n], step_s[k]))
            xyzw[k] = q
            whole_s += step_s[k]
        if ends.shape[0] > 0:
            x, y, z = vector_of(product(quaternion(ends[n]), inverted(q)))
            for k in range(first, last[n]):
                span_s += step_s[k]
                share = span_s / whole_s
                xyzw[k] = product(quaternion_of(share * x, share * y, share * z), quaternion(xyzw[k]))
        first = last[n]


# -- start and rest


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _upright(force: FloatArray) -> Quaternion:
    """The shortest rotation that takes a force to up."""
    norm = _norm(force)
    if norm == 0.0 or force[2] < -0.999999 * norm:
        return (0.0, 0.0, 0.0, 1.0) if norm == 0.0 else (1.0, 0.0, 0.0, 0.0)
    x, y, w = force[1] / norm, -force[0] / norm, 1.0 + force[2] / norm
    length = math.sqrt(x * x + y * y + w * w)
    return x / length, y / length, 0.0, w / length


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _set_up(s: Any, r: Any, step: Any, pause_s: float) -> None:
    """Begin before the first increment of a stretch: anew, or after a pause with the bias found so far."""
    kept = s.p[BIAS : BIAS + 3, BIAS : BIAS + 3].copy()
    s.p[:] = np.diag(s.fresh)
    if s.running:
        s.p[BIAS : BIAS + 3, BIAS : BIAS + 3] = kept + r.bias_walk_rad_s_sqrt_s**2 * pause_s * np.eye(3)
    s.running = s.starting = True
    s.resting = s.rest_known = False
    s.still_s = s.start_s = 0.0
    s.start_force[:], s.speed[:] = 0.0, 0.0
    s.level[:] = _upright(step.force)
    s.start_turn[:] = s.level  # in level axes: those of a sensor upside down would turn with every reading


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _begin(s: Any, step: Any) -> None:
    """Set up from the mean force since the start."""
    turn = quaternion(s.start_turn)
    x, y, z = rotated(turn, _three(step.force))
    s.start_force[0] += x
    s.start_force[1] += y
    s.start_force[2] += z
    turn = product(turn, quaternion(step.turn))
    s.start_turn[:] = turn
    s.start_s += step.duration_s
    s.level[:] = product(_upright(s.start_force), turn)
    s.speed[:] = 0.0
    s.starting = s.start_s < (_START_S if s.still_s > 0.5 * _START_S else _MOVING_START_S)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _rest(s: Any, r: Any, step: Any) -> None:
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
        _norm(rate_off) < r.rest_rate_rad_s
        and _norm(force_off) < r.rest_force_m_s2
        and _norm(s.rest_rate - s.bias) < r.rest_bias_rad_s + 3.0 * bias_sd
    )
    s.still_s = s.still_s + step.duration_s if still else 0.0
    s.resting = s.still_s > r.rest_after_s


# -- the Kalman filter


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _predict(s: Any, r: Any, step: Any, f: FloatArray) -> None:
    """Predict over one increment; fill its transition."""
    _rest(s, r, step)
    level, duration = quaternion(s.level), step.duration_s
    f[:] = np.eye(SIZE)
    vx, vy, vz = _three(s.speed)
    for j in range(3):
        axis = (1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0)
        x, y, z = rotated(level, axis)
        span = 0.0 if s.resting else duration
        f[0, BIAS + j], f[1, BIAS + j], f[2, BIAS + j] = -span * x, -span * y, -span * z
        f[6, BIAS + j] = span * (vz * y - vy * z)
        f[7, BIAS + j] = span * (vx * z - vz * x)
        f[8, BIAS + j] = span * (vy * x - vx * y)
    f[6, 1], f[7, 0] = r.gravity_m_s2 * duration, -r.gravity_m_s2 * duration
    shock = max(_norm(step.force) - _SHOCK_M_S2 * duration, 0.0)  # a knock, whose reading may be cut off
    noise = r.gyro_noise_rad_sqrt_s**2 + (r.gyro_scale_noise_sqrt_s * _norm(step.rate - s.bias)) ** 2
    if s.resting:
        noise = (_REST_NOISE * r.gyro_noise_rad_sqrt_s) ** 2
    step.noise[:3] = noise * duration + step.lost_rad2
    step.noise[3:6] = r.bias_walk_rad_s_sqrt_s**2 * duration
    step.noise[6:] = r.force_noise_m_s_sqrt_s**2 * duration + shock**2
    s.p[:] = f @ s.p @ f.T
    for i in range(SIZE):
        s.p[i, i] += step.noise[i]
    x, y, z = rotated(level, _three(step.force))
    s.speed[0] += x
    s.speed[1] += y
    s.speed[2] += z - r.gravity_m_s2 * duration
    if not s.resting:
        s.level[:] = product(level, quaternion(step.turn))
    step.predicted[:], step.predicted_speed[:] = s.level, s.speed


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _correct_by_speed(s: Any, r: Any, step: Any) -> None:
    """Correct by a velocity of zero, whose error is a hand's, or smaller at rest, and persists.

    A velocity tells nothing of turning about up: its own direction turns as likely. So neither heading nor
    the bias about up is corrected by it, and their errors count as noise (Schmidt).
    """
    speed, time_s = (_REST_SPEED_M_S, _REST_TIME_S) if s.resting else (r.speed_m_s, r.speed_time_s)
    up = np.array(rotated(inverted(quaternion(s.level)), (0.0, 0.0, 1.0)))
    gain = _correct(s.p, SPEED, 2.0 * speed**2 * time_s / step.duration_s, up)
    _inject(s, -gain @ s.speed)


_LEVEL = np.zeros(3)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _correct(p: FloatArray, first: int, variance: float, up: FloatArray) -> FloatArray:
    """Correct a covariance by an observation of three states; return the gain, shape (9, 3).

    The heading is found elsewhere, and corrected by nothing; nor is the bias about `up`.
    """
    cross = p[first : first + 3].copy()
    total = cross[:, first : first + 3] + variance * np.eye(3)
    gain = cross.T.copy() @ inverse(total)[0]
    gain[2] = 0.0
    for j in range(3):
        about_up = up[0] * gain[3, j] + up[1] * gain[4, j] + up[2] * gain[5, j]
        for i in range(3):
            gain[3 + i, j] -= about_up * up[i]
    rest = p - gain @ cross
    p[:] = rest - (rest[:, first : first + 3] - variance * gain) @ gain.T
    return gain


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _inject(s: Any, error: FloatArray) -> None:
    """Apply the estimated error to the state."""
    turn = quaternion_of(error[0], error[1], error[2])
    s.level[:] = product(turn, quaternion(s.level))
    s.speed[:] = rotated(turn, _three(s.speed))
    s.speed[:] = s.speed + error[SPEED:]
    s.bias[:] = s.bias + error[BIAS:SPEED]


# -- backward


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def smooth_steps(
    steps: Any,
    covariance: FloatArray,
    transition: FloatArray,
    first: int,
    levels: FloatArray,
    biases: FloatArray,
) -> None:
    """Smooth the steps from `first` on [5]_; before it, go back by the gyroscope.

    Parameters
    ----------
    steps : structured ndarray, shape (n,), of `STEP`
    covariance, transition : ndarray, shape (n, 9, 9)
        The covariances become the smoothed ones.
    first : int
        The step at whose end the filter had started.
    levels, biases : ndarray, shapes (n + 1, 4) and (n + 1, 3)
        Filled, at the start of the stretch and at the end of each step.
    """
    n = steps.shape[0]
    levels[n], biases[n] = steps[n - 1].level, steps[n - 1].bias
    speed, off = steps[n - 1].speed.copy(), np.empty(SIZE)
    for k in range(n - 2, first - 1, -1):
        step, after, f, p = steps[k], steps[k + 1], transition[k + 1], covariance[k]
        ahead = f @ p
        predicted = ahead @ f.T + np.diag(after.noise)
        gain = np.linalg.solve(predicted, ahead).T
        covariance[k] = p + gain @ (covariance[k + 1] - predicted) @ gain.T
        turn = product(quaternion(levels[k + 2]), inverted(quaternion(after.predicted)))
        off[:3] = vector_of(turn)
        off[3:6] = biases[k + 2] - step.bias
        off[6:] = speed
        off[6:] -= np.array(rotated(turn, _three(after.predicted_speed)))
        error = gain @ off
        turn = quaternion_of(error[0], error[1], error[2])
        levels[k + 1] = product(turn, quaternion(step.level))
        biases[k + 1] = step.bias + error[BIAS:SPEED]
        speed[:] = rotated(turn, _three(step.speed))
        speed += error[SPEED:]
    for k in range(first, -1, -1):
        step = steps[k]
        biases[k], levels[k] = biases[k + 1], levels[k + 1]
        if not step.resting:
            turn = product(quaternion(step.turn), _turn(step.start_bias, biases[k], step.duration_s))
            levels[k] = product(quaternion(levels[k + 1]), inverted(turn))
