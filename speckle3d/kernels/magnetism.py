"""Judging a stretch of magnetic field readings: the arithmetic of `xsens.fusion.detectors.FieldMonitor`.

That class says what is done and why; this does the same on bare arrays, laid out in `orientation_arrays`.
"""

import math

from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation_arrays import (
    AGE,
    BETTER,
    BODY,
    CANDIDATE,
    CLEAN,
    CONFIRMED,
    DIP_TOLERANCE,
    DISTURBS,
    DURATION,
    FIELD,
    FIRST_LEARNT_S,
    FIRST_UNEVEN,
    FIT,
    FITTING,
    FOUND,
    HAS,
    HORIZONTAL,
    IRON,
    IRON_KNOWN,
    IRON_MEMORY_S,
    IRON_PRIOR,
    KNOWN,
    LEARNT_S,
    MEAN_TURN,
    MEMORY_S,
    MISFIT,
    NORM_TOLERANCE,
    PROVED_S,
    READING,
    RESTART,
    RESTARTED,
    RIGHT,
    SMOOTH_HORIZONTAL,
    SMOOTH_VERTICAL,
    SMOOTHING_S,
    SQUARE,
    STARTING_S,
    STEEPEST,
    SUM_TURN,
    SUMS,
    SYSTEM,
    TURNED,
    TURNING,
    TURNS,
    UNDISTURBED_S,
    UNEVEN,
    VARIANCE,
    VECTOR,
    VERTICAL,
    WEIGHT,
    WORLD,
)
from speckle3d.kernels.rotations import apply_into, solve_into

_ROOM, _FOUND_IRON, _LEFT = 0, 3, 6
"""Of a fit: the room's field, the iron's, and the mean square residual."""


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _add(
    sums: FloatArray, memory_s: float, pose: FloatArray, field: FloatArray, misfit: float, s: float
) -> None:
    keep = math.exp(-s / memory_s)
    for k in range(SUMS):
        sums[k] *= keep
    sums[WEIGHT] += s
    sums[SQUARE] += s * (field[0] * field[0] + field[1] * field[1] + field[2] * field[2])
    sums[MISFIT] += s * misfit
    for i in range(3):
        sums[WORLD + i] += s * field[i]
        sums[BODY + i] += s * (field[0] * pose[i] + field[1] * pose[3 + i] + field[2] * pose[6 + i])
    for k in range(9):
        sums[SUM_TURN + k] += s * pose[k]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _fit(sums: FloatArray, prior: float, work: FloatArray) -> None:
    """Fill the room's field and the iron's by their closed form, and what they leave."""
    weight = sums[WEIGHT]
    turn, system, right = work[MEAN_TURN : MEAN_TURN + 3], work[SYSTEM : SYSTEM + 3], work[RIGHT : RIGHT + 3]
    fit = work[FIT]
    for i in range(3):
        for j in range(3):
            turn[i, j] = sums[SUM_TURN + 3 * i + j] / weight
    for i in range(3):
        right[i, 0] = sums[BODY + i] / weight
        for k in range(3):
            right[i, 0] -= turn[k, i] * (sums[WORLD + k] / weight)
        for j in range(3):
            system[i, j] = 1.0 + prior if i == j else 0.0
            for k in range(3):
                system[i, j] -= turn[k, i] * turn[k, j]
    solve_into(system, right)
    rooms = irons = across = 0.0
    for i in range(3):
        iron = right[i, 0]
        turned = turn[i, 0] * right[0, 0] + turn[i, 1] * right[1, 0] + turn[i, 2] * right[2, 0]
        room = sums[WORLD + i] / weight - turned
        fit[_ROOM + i], fit[_FOUND_IRON + i] = room, iron
        rooms += room * room
        irons += iron * iron
        across += room * turned
    fit[_LEFT] = max(sums[SQUARE] / weight - rooms - irons - 2.0 * across, 0.0)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _learnt(m: FloatArray, limits: FloatArray, fit: FloatArray, other: FloatArray) -> bool:
    """Replace the reference by `fit`, that of the candidate, if this is clearly better.

    Then `fit` begins with the room's field of the new one, which keeps the iron if another room alone
    explains the readings nearly as well.
    """
    sums = m[CANDIDATE : CANDIDATE + SUMS]
    weight = sums[WEIGHT]
    left, square, rooms = fit[_LEFT], sums[SQUARE] / weight, 0.0
    uneven = limits[UNEVEN] if m[CONFIRMED] > 0.0 else limits[FIRST_UNEVEN]
    if left > uneven * uneven * (fit[0] * fit[0] + fit[1] * fit[1] + fit[2] * fit[2]):
        return False
    if 1.5 * sums[MISFIT] / weight < limits[BETTER] * left:
        return False
    for i in range(3):
        turned = 0.0
        for j in range(3):
            turned += sums[SUM_TURN + 3 * i + j] / weight * m[IRON + j]
        other[i] = sums[WORLD + i] / weight - turned
        square += m[IRON + i] * m[IRON + i] - 2.0 * m[IRON + i] * sums[BODY + i] / weight
        rooms += other[i] * other[i]
    same_iron = max(square - rooms, 0.0) < limits[BETTER] * left
    for i in range(3):
        if same_iron:
            fit[_ROOM + i] = other[i]
        else:
            m[IRON + i] = fit[_FOUND_IRON + i]
    for k in range(SUMS):
        if not same_iron:
            m[KNOWN + k] = sums[k]
        sums[k] = 0.0
    if not same_iron:
        m[IRON_KNOWN] = 1.0
    m[HORIZONTAL], m[VERTICAL] = math.hypot(fit[0], fit[1]), fit[2]
    m[FITTING] = m[TURNED] = 0.0
    return True


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def read_field(
    m: FloatArray,
    limits: FloatArray,
    pose: FloatArray,
    field: FloatArray,
    rate_rad_s: float,
    duration_s: float,
    work: FloatArray,
) -> None:
    """Judge one reading.

    Parameters
    ----------
    m : ndarray, shape (MONITOR,)
        The monitor, changed in place; zeros but for the time of fitting at the start.
    limits : ndarray, shape (LIMITS,)
    pose : ndarray, shape (9,)
        World from sensor.
    field : ndarray, shape (3,)
        In the world's axes.
    rate_rad_s, duration_s : float
    work : ndarray, shape (WORK, 13)
        What is found is filled; the room's field only where the reference was replaced.
    """
    reading = work[FOUND]
    if m[HAS] == 0.0:
        m[HAS], m[HORIZONTAL], m[VERTICAL] = 1.0, math.hypot(field[0], field[1]), field[2]
    horizontal, vertical = m[HORIZONTAL], m[VERTICAL]
    for i in range(3):
        reading[CLEAN + i] = field[i]
        for j in range(3):
            reading[CLEAN + i] -= pose[3 * i + j] * m[IRON + j]
    share = 1.0 - math.exp(-duration_s / limits[SMOOTHING_S]) if m[AGE] != 0.0 else 1.0
    m[SMOOTH_HORIZONTAL] += share * (math.hypot(reading[CLEAN], reading[CLEAN + 1]) - m[SMOOTH_HORIZONTAL])
    m[SMOOTH_VERTICAL] += share * (reading[CLEAN + 2] - m[SMOOTH_VERTICAL])
    m[AGE] += duration_s
    norm = math.hypot(horizontal, vertical)
    seen = math.hypot(m[SMOOTH_HORIZONTAL], m[SMOOTH_VERTICAL])
    dip = math.atan2(-m[SMOOTH_VERTICAL], m[SMOOTH_HORIZONTAL])
    fits = (
        abs(seen - norm) <= limits[NORM_TOLERANCE] * norm
        and abs(dip - math.atan2(-vertical, horizontal)) <= limits[DIP_TOLERANCE]
    )
    m[FITTING] = m[FITTING] + duration_s if fits else 0.0
    across, along = m[SMOOTH_HORIZONTAL] - horizontal, m[SMOOTH_VERTICAL] - vertical
    off = across * across + along * along
    if m[AGE] <= limits[STARTING_S]:
        share = duration_s / m[AGE]
    elif m[FITTING] < limits[UNDISTURBED_S]:
        share = 0.0
    else:
        share = duration_s / limits[MEMORY_S]
    m[HORIZONTAL], m[VERTICAL] = horizontal + share * across, vertical + share * along
    reading[RESTARTED] = 0.0
    if rate_rad_s > limits[TURNING]:
        _turning(m, limits, pose, field, fits, off, duration_s, work)
    steep = horizontal <= limits[STEEPEST] * norm
    reading[DISTURBS] = 1.0 if steep or m[FITTING] < limits[UNDISTURBED_S] else 0.0
    reading[VARIANCE] = math.inf if steep else off / (2.0 * horizontal * horizontal)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _turning(
    m: FloatArray,
    limits: FloatArray,
    pose: FloatArray,
    field: FloatArray,
    fits: bool,
    off: float,
    duration_s: float,
    work: FloatArray,
) -> None:
    """Learn from a reading while turning: refine the iron once known, then perhaps replace the reference."""
    m[TURNED] += duration_s if fits else 0.0
    after_s = limits[LEARNT_S] if m[CONFIRMED] > 0.0 else limits[FIRST_LEARNT_S]
    reading, fit = work[FOUND], work[FIT]
    for place in (KNOWN, CANDIDATE):
        refines = place == KNOWN
        if refines and not (fits and m[IRON_KNOWN] > 0.0):
            continue
        sums = m[place : place + SUMS]
        _add(sums, limits[IRON_MEMORY_S] if refines else limits[MEMORY_S], pose, field, off, duration_s)
        if not refines and sums[WEIGHT] < after_s:
            continue
        _fit(sums, limits[IRON_PRIOR], work)
        if refines:
            m[HORIZONTAL], m[VERTICAL] = math.hypot(fit[0], fit[1]), fit[2]
            for i in range(3):
                m[IRON + i] = fit[_FOUND_IRON + i]
        elif _learnt(m, limits, fit, work[TURNS]) and m[CONFIRMED] == 0.0:
            reading[RESTARTED] = 1.0
            for i in range(3):
                reading[RESTART + i] = fit[_ROOM + i]
    if m[TURNED] > limits[PROVED_S]:
        m[CONFIRMED] = 1.0


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def judge_fields(
    poses: FloatArray,
    middles: FloatArray,
    steps: FloatArray,
    rates: FloatArray,
    backward: bool,
    monitor: FloatArray,
    limits: FloatArray,
    readings: FloatArray,
    work: FloatArray,
) -> None:
    """Judge a stretch's readings in one direction of time, those by a wrong first reference again.

    Parameters
    ----------
    poses, middles : ndarray, shape (n, 9)
        World from sensor at the start of each step, to which the field belongs, and in its middle.
    steps : ndarray, shape (n, STEP)
        Of which the fields, NaN where there is none, and durations are used.
    rates : ndarray, shape (n,)
    backward : bool
    monitor : ndarray, shape (MONITOR,)
        Fresh.
    limits : ndarray, shape (LIMITS,)
    readings : ndarray, shape (n, READING)
        Filled; NaN where there is no reading.
    work : ndarray, shape (WORK, 13)
        Buffers.
    """
    n = rates.shape[0]
    field = work[VECTOR]
    wrong = 0
    for seen in range(2 * n):
        turned_back = seen >= n
        if turned_back and seen - n >= wrong:
            break
        at = wrong - 1 - (seen - n) if turned_back else seen
        k = n - 1 - at if backward else at
        step, reading = steps[k], readings[k]
        for i in range(READING):
            reading[i] = math.nan
        if math.isnan(step[FIELD]):
            continue
        apply_into(poses[k], step[FIELD : FIELD + 3], field)
        read_field(monitor, limits, middles[k], field, rates[k], step[DURATION], work)
        for i in range(READING):
            reading[i] = work[FOUND, i]
        if not turned_back and reading[RESTARTED] > 0.0:
            wrong = seen
