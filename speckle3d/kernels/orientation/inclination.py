"""Inclination and turning over a stretch of samples: an error-state Kalman filter by short increments.

The accelerometer is integrated to velocity, which stays near zero in a hand: over many swings that shows the
direction of gravity in spite of movement, where the accelerometer itself shows it only at rest. The attitude
error is the invariant one (velocity turns with it), so that errors of heading and velocity stay separate. The
magnetometer has no part in it: it cannot tilt the orientation; `heading` beside this turns that to north.

References
----------
.. [1] F. L. Markley, "Attitude error representations for Kalman filtering", J. Guid. Control Dyn., 2003.
.. [2] A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE TAC, 2017.
.. [3] D. Laidig, T. Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation and magnetic
   disturbance rejection", Information Fusion, 2023 (rest detection; inclination and heading apart).
"""

import math

from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.orientation.inclination_arrays import (
    ASSUMED,
    BIAS,
    BIAS_WALK,
    BRIDGED,
    DEVIATION,
    DURATION,
    FIRST_MOVING_S,
    FIRST_S,
    FORCE,
    GRAVITY,
    HEADING_APART,
    LAST_RATE,
    LEVEL,
    LONGEST_S,
    MATRIX,
    NOISE,
    NOISES,
    PREDICTED,
    PREDICTED_SPEED,
    RATE,
    RESIDUAL,
    REST_BIAS_VARIANCE,
    REST_FORCE,
    REST_KNOWN,
    REST_MEMORY_S,
    REST_RATE,
    REST_SPEED_VARIANCE,
    RESTED,
    RESTING,
    RUNNING,
    SHOWS,
    SIZE,
    SPEED,
    SPEED_VARIANCE,
    START_FORCE,
    START_S,
    START_TURN,
    STARTED,
    STARTING,
    STEP_BIAS,
    STEP_SPEED,
    STEP_START,
    STEP_START_BIAS,
    STILL,
    STILL_BIAS,
    STILL_FORCE,
    STILL_RATE,
    STILL_S,
    TRANSITION,
    TURN,
    TURNS,
)
from speckle3d.kernels.orientation.increments import rate_beyond, sum_samples
from speckle3d.kernels.orientation.kalman import predict_covariance, update
from speckle3d.kernels.orientation.rotations import product_into, turn_into

SHOCK_M_S2 = 60.0
"""Mean force of an increment beyond which it is not believed: a board shaken by hand in BROAD reads 51."""

GOES_ON = -1.0
"""Pause before a stretch that is none: the stretch goes on from the last one."""


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def run_filter(
    step_s: FloatArray,
    rate_rad_s: FloatArray,
    force_m_s2: FloatArray,
    field_au: FloatArray,
    last: IntArray,
    chunk: int,
    pause_s: float,
    s: FloatArray,
    p: FloatArray,
    fresh: FloatArray,
    limits: FloatArray,
    steps: FloatArray,
    within: FloatArray,
    covariance: FloatArray,
    transition: FloatArray,
    work: FloatArray,
) -> None:
    """Run the filter over a stretch.

    Parameters
    ----------
    step_s : ndarray, shape (m,)
    rate_rad_s, force_m_s2, field_au : ndarray, shape (m, 3)
    last : ndarray of int, shape (n,)
        Sample after each increment's last.
    chunk : int
        Increments summed with one bias.
    pause_s : float
        Time since the stretch before, of which `s` and `p` are the end; `GOES_ON` if there was no pause.
    s, p : ndarray, shapes (STATE,) and (9, 9)
        State and covariance of the filter, changed in place.
    fresh : ndarray, shape (9, 9)
        Covariance at a start.
    limits : ndarray, shape (LIMITS,)
    steps, within : ndarray, shapes (n, STEP) and (m, SAMPLE)
        Filled.
    covariance, transition : ndarray, shape (n, 9, 9), or (0, 9, 9) if they are not wanted
        Filled.
    work : ndarray, shape (WORK, 9)
        Buffers, zeros.
    """
    whole = last.shape[0]
    if whole > 1 and last[whole - 1] - last[whole - 2] != last[0]:
        whole -= 1  # samples left over, summed with a bias of their own
    for n in range(last.shape[0]):
        step = steps[n]
        for i in range(3):
            step[ASSUMED + i] = s[BIAS + i] if n % chunk == 0 or n == whole else steps[n - 1, ASSUMED + i]
        first = 0 if n == 0 else last[n - 1]
        before = s[LAST_RATE : LAST_RATE + 3]
        if n == 0 and pause_s != GOES_ON:
            before[:] = math.nan
        longest_s = limits[LONGEST_S]
        sum_samples(step_s, rate_rad_s, force_m_s2, field_au, first, last[n], longest_s, before, step, within)
        if n == 0 and pause_s != GOES_ON:
            _set_up(s, p, fresh, limits, step, pause_s)
        for i in range(9):
            step[STEP_START + i] = s[LEVEL + i]
        for i in range(3):
            step[STEP_START_BIAS + i] = s[BIAS + i]
        _predict(s, p, limits, step, work)
        if s[STARTING] > 0.0:
            _begin(s, limits, step, work[TURNS])
        else:
            _speed_is_zero(s, p, limits, step, work)
            _rest_shows_bias(s, p, limits, step, work)
        _note(s, p, step, work)
        if covariance.shape[0] > 0:
            for i in range(SIZE):
                for j in range(SIZE):
                    covariance[n, i, j], transition[n, i, j] = p[i, j], work[TRANSITION + i, j]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _note(s: FloatArray, p: FloatArray, step: FloatArray, work: FloatArray) -> None:
    """Note the filter in the step, after its correction."""
    for i in range(9):
        step[MATRIX + i] = s[LEVEL + i]
        step[NOISE + i] = work[NOISES + i, i]
    for i in range(3):
        step[STEP_SPEED + i], step[STEP_BIAS + i] = s[SPEED + i], s[BIAS + i]
    for i in range(6):
        step[DEVIATION + i] = math.sqrt(p[i, i])
    step[RESTED], step[STARTED] = s[RESTING], 1.0 - s[STARTING]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _upright(force: FloatArray, out: FloatArray) -> None:
    """Fill the shortest rotation that takes `force` to up."""
    norm = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    x, y, z = 0.0, 0.0, 1.0
    if norm > 0.0:
        x, y, z = force[0] / norm, force[1] / norm, force[2] / norm
    sine = math.sqrt(x * x + y * y)
    if sine < 1e-9:
        for i in range(9):
            out[i] = 0.0
        out[0], out[4], out[8] = 1.0, math.copysign(1.0, z), math.copysign(1.0, z)
        return
    angle = math.atan2(sine, z)
    turn_into(y / sine * angle, -x / sine * angle, 0.0, out)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _set_up(
    s: FloatArray, p: FloatArray, fresh: FloatArray, limits: FloatArray, step: FloatArray, pause_s: float
) -> None:
    """Begin before the first increment of a stretch: anew, or after a pause with the bias found so far."""
    walk = limits[BIAS_WALK] * limits[BIAS_WALK] * pause_s
    for i in range(p.shape[0]):
        for j in range(p.shape[0]):
            if s[RUNNING] == 0.0 or not (3 <= i < 6 and 3 <= j < 6):
                p[i, j] = fresh[i, j]
        if 3 <= i < 6 and s[RUNNING] > 0.0:
            p[i, i] += walk
    s[RUNNING] = s[STARTING] = 1.0
    s[REST_KNOWN] = s[STILL] = s[START_S] = 0.0
    for i in range(3):
        s[REST_FORCE + i] = s[START_FORCE + i] = s[SPEED + i] = 0.0
    _upright(step[FORCE : FORCE + 3], s[LEVEL : LEVEL + 9])
    for i in range(9):  # in level axes: those of a sensor upside down would turn with every reading
        s[START_TURN + i] = s[LEVEL + i]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _rest(s: FloatArray, p: FloatArray, limits: FloatArray, step: FloatArray) -> None:
    """Note whether the sensor rests."""
    duration = step[DURATION]
    share = duration / (limits[REST_MEMORY_S] + duration)
    rate_off = force_off = bias_off = 0.0
    for i in range(3):
        if s[REST_KNOWN] == 0.0:
            s[REST_RATE + i], s[REST_FORCE + i] = step[RATE + i], step[FORCE + i] / duration
        off = step[RATE + i] - s[REST_RATE + i]
        rate_off += off * off
        s[REST_RATE + i] += share * off
        off = step[FORCE + i] / duration - s[REST_FORCE + i]
        force_off += off * off
        s[REST_FORCE + i] += share * off
        off = s[REST_RATE + i] - s[BIAS + i]
        bias_off += off * off
    s[REST_KNOWN] = 1.0
    bias_sd = math.sqrt(max(p[3, 3], p[4, 4], p[5, 5], 0.0))
    still = (
        math.sqrt(rate_off) < limits[STILL_RATE]
        and math.sqrt(force_off) < limits[STILL_FORCE]
        and math.sqrt(bias_off) < limits[STILL_BIAS] + 3.0 * bias_sd
    )
    s[STILL] = s[STILL] + duration if still else 0.0
    s[RESTING] = 1.0 if s[STILL] > limits[STILL_S] else 0.0


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _rate(s: FloatArray, step: FloatArray) -> float:
    x, y, z = step[RATE] - s[BIAS], step[RATE + 1] - s[BIAS + 1], step[RATE + 2] - s[BIAS + 2]
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _shock(limits: FloatArray, step: FloatArray) -> float:
    """Variance of the velocity by a force that no hand gives: a knock, whose reading may be cut off."""
    x, y, z = step[FORCE], step[FORCE + 1], step[FORCE + 2]
    beyond = math.sqrt(x * x + y * y + z * z) - SHOCK_M_S2 * step[DURATION]
    return beyond * beyond if beyond > 0.0 else 0.0


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _predict(s: FloatArray, p: FloatArray, limits: FloatArray, step: FloatArray, work: FloatArray) -> None:
    """Predict over one increment."""
    _rest(s, p, limits, step)
    f, level = work[TRANSITION : TRANSITION + SIZE], s[LEVEL : LEVEL + 9]
    duration, resting = step[DURATION], s[RESTING] > 0.0
    for i in range(p.shape[0]):
        for j in range(p.shape[0]):
            f[i, j] = 1.0 if i == j else 0.0
    if not resting:
        vx, vy, vz = s[SPEED], s[SPEED + 1], s[SPEED + 2]
        for j in range(3):
            x, y, z = level[j] * duration, level[3 + j] * duration, level[6 + j] * duration
            f[0, 3 + j], f[1, 3 + j], f[2, 3 + j] = -x, -y, -z
            f[6, 3 + j], f[7, 3 + j], f[8, 3 + j] = vz * y - vy * z, vx * z - vz * x, vy * x - vx * y
    f[6, 1], f[7, 0] = limits[GRAVITY] * duration, -limits[GRAVITY] * duration
    shock = _shock(limits, step)
    predict_covariance(p, _rate(s, step), step[BRIDGED], shock, resting, limits, duration, work)
    for i in range(3):
        x, y, z = step[FORCE], step[FORCE + 1], step[FORCE + 2]
        s[SPEED + i] += level[3 * i] * x + level[3 * i + 1] * y + level[3 * i + 2] * z
    s[SPEED + 2] -= limits[GRAVITY] * duration
    if not resting:
        turn = step[PREDICTED : PREDICTED + 9]
        product_into(level, step[TURN : TURN + 9], level)
        x, y, z = rate_beyond(step, s[BIAS : BIAS + 3])
        turn_into(x * duration, y * duration, z * duration, turn)
        product_into(level, turn, level)
    for i in range(9):
        step[PREDICTED + i] = level[i]
    for i in range(3):
        step[PREDICTED_SPEED + i] = s[SPEED + i]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _begin(s: FloatArray, limits: FloatArray, step: FloatArray, up: FloatArray) -> None:
    """Set up from the mean force since the start; `up` is a buffer."""
    turn = s[START_TURN : START_TURN + 9]
    for i in range(3):
        for j in range(3):
            s[START_FORCE + i] += turn[3 * i + j] * step[FORCE + j]
    product_into(turn, step[TURN : TURN + 9], turn)
    s[START_S] += step[DURATION]
    _upright(s[START_FORCE : START_FORCE + 3], up)
    product_into(up, turn, s[LEVEL : LEVEL + 9])
    for i in range(3):
        s[SPEED + i] = 0.0
    enough = limits[FIRST_S] if s[STILL] > 0.5 * limits[FIRST_S] else limits[FIRST_MOVING_S]
    s[STARTING] = 0.0 if s[START_S] >= enough else 1.0


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _speed_is_zero(
    s: FloatArray, p: FloatArray, limits: FloatArray, step: FloatArray, work: FloatArray
) -> None:
    """Correct by a velocity of zero, whose error is a hand's, or smaller at rest, and persists."""
    variance = limits[REST_SPEED_VARIANCE] if s[RESTING] > 0.0 else limits[SPEED_VARIANCE]
    for i in range(3):
        for j in range(SIZE):
            work[SHOWS + i, j] = 1.0 if j == 6 + i else 0.0
        work[RESIDUAL, i] = -s[SPEED + i]
    update(variance / step[DURATION], s, p, True, limits[HEADING_APART] > 0.0, work)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _rest_shows_bias(
    s: FloatArray, p: FloatArray, limits: FloatArray, step: FloatArray, work: FloatArray
) -> None:
    """Correct by the gyroscope's reading at rest."""
    if s[RESTING] == 0.0:
        return
    for i in range(3):
        for j in range(SIZE):
            work[SHOWS + i, j] = 1.0 if j == 3 + i else 0.0
        work[RESIDUAL, i] = step[RATE + i] - s[BIAS + i]
    update(limits[REST_BIAS_VARIANCE] / step[DURATION], s, p, False, limits[HEADING_APART] > 0.0, work)
