"""The orientation filter over a stretch of samples: the arithmetic of `xsens.fusion.errorstate`.

`ErrorStateFilter` there says what is done and why, step by step and with filterpy's Kalman filter; this runs
the same on bare arrays, laid out in `orientation_arrays`, samples and increments included.
"""

import math

from numba import njit

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.kernels.increments import sum_samples
from speckle3d.kernels.magnetism import read_field
from speckle3d.kernels.orientation_arrays import (
    ASSUMED,
    BEFORE,
    BIAS,
    BIAS_WALK,
    CLEAN,
    DISTURBED,
    DISTURBS,
    DURATION,
    FIELD,
    FIELD_MONITOR,
    FIELD_NOISE,
    FIELD_OFF_S,
    FIELD_PLACE_S,
    FIELD_SD,
    FIRST_S,
    FORCE,
    FOUND,
    GRAVITY,
    HEADING,
    LEVEL,
    MAGNETIC,
    MATRIX,
    MONITOR,
    NOISE,
    NOISES,
    NORTH_BIAS,
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
    RESTART,
    RESTARTED,
    RESTED,
    RESTING,
    RUNNING,
    SD,
    SHOWS,
    SIZE,
    SMOOTHED,
    SPEED,
    SPEED_VARIANCE,
    START_FIELD,
    START_FIELD_S,
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
    STRAY,
    STRAYED,
    TRANSITION,
    TURN,
    TURNS,
    VARIANCE,
    VECTOR,
)
from speckle3d.kernels.orientation_kalman import (
    KINDS,
    NEW_NORTH,
    NORTH_BIAS_SEEN,
    SPEED_ZERO,
    predict_covariance,
    update,
    wrapped,
)
from speckle3d.kernels.rotations import apply_into, product_into, turn_into


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
        Time since the stretch before, of which `s` and `p` are the end.
    s, p : ndarray, shapes (STATE,) and (13, 13)
        State and covariance of the filter, changed in place.
    fresh : ndarray, shape (13, 13)
        Covariance at a start.
    limits : ndarray, shape (LIMITS,)
    steps, within : ndarray, shapes (n, STEP) and (m, SAMPLE)
        Filled.
    covariance, transition : ndarray, shape (n, 9, 9), or (0, 9, 9) if they are not wanted
        Filled.
    work : ndarray, shape (WORK, 13)
        Buffers, zeros.
    """
    whole = last.shape[0]
    if whole > 1 and last[whole - 1] - last[whole - 2] != last[0]:
        whole -= 1  # samples left over, summed with a bias of their own
    bias = NORTH_BIAS if limits[MAGNETIC] > 0.0 else BIAS
    for n in range(last.shape[0]):
        step = steps[n]
        for i in range(3):
            step[ASSUMED + i] = s[BIAS + i] if n % chunk == 0 or n == whole else steps[n - 1, ASSUMED + i]
        first = 0 if n == 0 else last[n - 1]
        sum_samples(step_s, rate_rad_s, force_m_s2, field_au, first, last[n], step, within)
        if n == 0:
            _set_up(s, p, fresh, limits, step, pause_s, work[VECTOR])
        _about_up(s, step, STEP_START)
        for i in range(3):
            step[STEP_START_BIAS + i] = s[bias + i]
        _predict(s, p, limits, step, work)
        starting = s[STARTING] > 0.0
        if starting:
            _begin(s, limits, step, work[TURNS], work[VECTOR])
        kinds = 0 if starting and s[STARTING] > 0.0 else KINDS
        for kind in range(NEW_NORTH if starting else SPEED_ZERO, kinds):
            if kind == NEW_NORTH and not _sees_field(s, limits, step, starting, work):
                break
            variance = _observe(kind, s, p, limits, step, work)
            if variance >= 0.0:
                update(kind, variance, s, p, limits[MAGNETIC] > 0.0, work)
        _about_up(s, step, MATRIX)
        for i in range(3):
            step[STEP_SPEED + i], step[STEP_BIAS + i] = s[SPEED + i], s[bias + i]
            step[SD + i] = math.sqrt(p[i, i])
        step[RESTED], step[STRAYED], step[STARTED] = s[RESTING], s[DISTURBED], 1.0 - s[STARTING]
        for i in range(SMOOTHED):
            step[NOISE + i] = work[NOISES + i, i]
            if covariance.shape[0] > 0:
                for j in range(SMOOTHED):
                    covariance[n, i, j], transition[n, i, j] = p[i, j], work[TRANSITION + i, j]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _about_up(s: FloatArray, step: FloatArray, at: int) -> None:
    """Note world from sensor in the step."""
    c, sine = math.cos(s[HEADING]), math.sin(s[HEADING])
    for j in range(3):
        x, y = s[LEVEL + j], s[LEVEL + 3 + j]
        step[at + j], step[at + 3 + j], step[at + 6 + j] = (
            c * x - sine * y,
            sine * x + c * y,
            s[LEVEL + 6 + j],
        )


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
    s: FloatArray,
    p: FloatArray,
    fresh: FloatArray,
    limits: FloatArray,
    step: FloatArray,
    pause_s: float,
    field: FloatArray,
) -> None:
    """Begin before the first increment of a stretch: anew, or after a pause with the bias found so far."""
    walk = limits[BIAS_WALK] * limits[BIAS_WALK] * pause_s
    for i in range(p.shape[0]):
        of_bias = 3 <= i < 6 or 9 <= i < 12
        for j in range(p.shape[0]):
            if s[RUNNING] == 0.0 or not (of_bias and (3 <= j < 6 or 9 <= j < 12)):
                p[i, j] = fresh[i, j]
        if of_bias and s[RUNNING] > 0.0:
            p[i, i] += walk
    s[RUNNING] = s[STARTING] = 1.0
    s[STRAY] = s[REST_KNOWN] = s[STILL] = s[START_S] = s[START_FIELD_S] = s[HEADING] = 0.0
    for i in range(3):
        s[REST_FORCE + i] = s[START_FORCE + i] = s[START_FIELD + i] = 0.0
        for j in range(3):
            s[START_TURN + 3 * i + j] = 1.0 if i == j else 0.0
    level = s[LEVEL : LEVEL + 9]
    _upright(step[FORCE : FORCE + 3], level)
    if limits[MAGNETIC] > 0.0 and not math.isnan(step[FIELD]):
        apply_into(level, step[FIELD : FIELD + 3], field)
        s[HEADING] = -math.atan2(field[1], field[0])


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
def _predict(s: FloatArray, p: FloatArray, limits: FloatArray, step: FloatArray, work: FloatArray) -> None:
    """Predict over one increment; note the level axes before it."""
    _rest(s, p, limits, step)
    f, level = work[TRANSITION : TRANSITION + SIZE], s[LEVEL : LEVEL + 9]
    duration, resting, magnetic = step[DURATION], s[RESTING] > 0.0, limits[MAGNETIC] > 0.0
    for i in range(p.shape[0]):
        for j in range(p.shape[0]):
            f[i, j] = 1.0 if i == j else 0.0
    if not resting:
        f[12, 12] = 1.0 - duration / limits[FIELD_PLACE_S]
        vx, vy, vz = s[SPEED], s[SPEED + 1], s[SPEED + 2]
        for j in range(3):
            x, y, z = level[j] * duration, level[3 + j] * duration, level[6 + j] * duration
            f[0, 3 + j], f[1, 3 + j] = -x, -y
            f[2, (9 if magnetic else 3) + j] = -z
            f[6, 3 + j], f[7, 3 + j], f[8, 3 + j] = vz * y - vy * z, vx * z - vz * x, vy * x - vx * y
    f[6, 1], f[7, 0] = limits[GRAVITY] * duration, -limits[GRAVITY] * duration
    predict_covariance(p, _rate(s, step), resting, limits, duration, work)
    s[STRAY] *= f[12, 12]
    for i in range(3):
        s[BEFORE + 3 * i], s[BEFORE + 3 * i + 1] = level[3 * i], level[3 * i + 1]
        s[BEFORE + 3 * i + 2] = level[3 * i + 2]
        if magnetic:
            s[HEADING] += level[6 + i] * duration * (s[BIAS + i] - s[NORTH_BIAS + i])
        x, y, z = step[FORCE], step[FORCE + 1], step[FORCE + 2]
        s[SPEED + i] += level[3 * i] * x + level[3 * i + 1] * y + level[3 * i + 2] * z
    s[SPEED + 2] -= limits[GRAVITY] * duration
    if not resting:
        turn = step[PREDICTED : PREDICTED + 9]
        product_into(level, step[TURN : TURN + 9], level)
        x, y, z = step[ASSUMED] - s[BIAS], step[ASSUMED + 1] - s[BIAS + 1], step[ASSUMED + 2] - s[BIAS + 2]
        turn_into(x * duration, y * duration, z * duration, turn)
        product_into(level, turn, level)
    for i in range(9):
        step[PREDICTED + i] = level[i]
    for i in range(3):
        step[PREDICTED_SPEED + i] = s[SPEED + i]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _begin(s: FloatArray, limits: FloatArray, step: FloatArray, up: FloatArray, field: FloatArray) -> None:
    """Set up from the mean force since the start, and north from the mean field; the last two are buffers."""
    turn, level, duration = s[START_TURN : START_TURN + 9], s[LEVEL : LEVEL + 9], step[DURATION]
    there = not math.isnan(step[FIELD])
    for i in range(3):
        for j in range(3):
            s[START_FORCE + i] += turn[3 * i + j] * step[FORCE + j]
            if there:
                s[START_FIELD + i] += turn[3 * i + j] * step[FIELD + j] * duration
    if there:
        s[START_FIELD_S] += duration
    product_into(turn, step[TURN : TURN + 9], turn)
    s[START_S] += duration
    _upright(s[START_FORCE : START_FORCE + 3], up)
    product_into(up, turn, level)
    for i in range(3):
        s[SPEED + i] = 0.0
    s[STARTING] = 0.0 if s[START_S] >= limits[FIRST_S] else 1.0
    if s[START_FIELD_S] > 0.0 and limits[MAGNETIC] > 0.0:
        _start_field(s, field)
        s[HEADING] = -math.atan2(field[1], field[0])


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _start_field(s: FloatArray, field: FloatArray) -> None:
    """Fill the start's mean field, in level axes."""
    for i in range(3):
        field[i] = 0.0
        for j in range(3):
            field[i] += s[START_FIELD + j] * s[START_TURN + 3 * j + i] / s[START_FIELD_S]
    apply_into(s[LEVEL : LEVEL + 9], field, field)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _sees_field(
    s: FloatArray, limits: FloatArray, step: FloatArray, starting: bool, work: FloatArray
) -> bool:
    """Whether there is a field, the start's or the step's, and then what is found of it."""
    field = work[VECTOR]
    there = s[START_FIELD_S] > 0.0 if starting else not math.isnan(step[FIELD])
    if not there or limits[MAGNETIC] == 0.0:
        return False
    if starting:
        _start_field(s, field)
    else:
        apply_into(s[BEFORE : BEFORE + 9], step[FIELD : FIELD + 3], field)
    monitor, level = s[FIELD_MONITOR : FIELD_MONITOR + MONITOR], s[LEVEL : LEVEL + 9]
    read_field(monitor, limits, level, field, _rate(s, step), step[DURATION], work)
    s[DISTURBED] = work[FOUND, DISTURBS]
    return True


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _observe(
    kind: int,
    s: FloatArray,
    p: FloatArray,
    limits: FloatArray,
    step: FloatArray,
    work: FloatArray,
) -> float:
    """Fill an observation's derivatives and residual; return its variance, negative if there is none."""
    shows, residual, duration = work[SHOWS : SHOWS + 3], work[RESIDUAL], step[DURATION]
    reading, resting, magnetic = work[FOUND], s[RESTING] > 0.0, limits[MAGNETIC] > 0.0
    for r in range(3):
        for j in range(SIZE):
            shows[r, j] = 0.0
    if kind == SPEED_ZERO:  # a velocity of zero, whose error is a hand's, or smaller at rest, and persists
        for i in range(3):
            shows[i, 6 + i], residual[i] = 1.0, -s[SPEED + i]
        return float((limits[REST_SPEED_VARIANCE] if resting else limits[SPEED_VARIANCE]) / duration)
    if kind <= NORTH_BIAS_SEEN:  # both copies of the bias, one by one, by the gyroscope's reading at rest
        of_north = kind == NORTH_BIAS_SEEN
        if not resting or (of_north and not magnetic):
            return -1.0
        for i in range(3):
            shows[i, (9 if of_north else 3) + i] = 1.0
            residual[i] = step[RATE + i] - s[(NORTH_BIAS if of_north else BIAS) + i]
        return float(limits[REST_BIAS_VARIANCE] / duration)
    shows[0, 2] = shows[0, 12] = 1.0
    x, y, z = reading[CLEAN], reading[CLEAN + 1], reading[CLEAN + 2]
    if kind == NEW_NORTH:  # a heading found beside iron, if it is far from that of the room's field
        place = limits[FIELD_SD] * limits[FIELD_SD]
        residual[0] = wrapped(-math.atan2(reading[RESTART + 1], reading[RESTART]) - s[HEADING] - s[STRAY])
        square = residual[0] * residual[0]
        if reading[RESTARTED] == 0.0 or not square > 9.0 * (p[2, 2] + place):
            return -1.0
        p[2, 2] += square
        return float(place)
    horizontal = x * x + y * y
    if reading[DISTURBS] > 0.0 or horizontal == 0.0:
        return -1.0
    shows[0, 0], shows[0, 1] = -z * x / horizontal, -z * y / horizontal
    residual[0] = wrapped(-math.atan2(y, x) - s[HEADING] - s[STRAY])
    noise = limits[FIELD_NOISE] * limits[FIELD_NOISE] + 2.0 * limits[FIELD_OFF_S] * reading[VARIANCE]
    return float(noise / duration)
