"""Judging a stretch of magnetic field readings: the arithmetic of `xsens.fusion.detectors.FieldMonitor`.

That class says what is done and why; this does the same on bare arrays.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.rotations import solve_into


class FieldLimits(NamedTuple):
    """Constants of the monitor, and those of its settings that it uses."""

    smoothing_s: float
    undisturbed_after_s: float
    turning_rad_s: float
    learnt_after_s: float
    starting_s: float
    iron_memory_s: float
    proved_after_s: float
    iron_prior: float
    uneven: float
    first_after_s: float
    first_uneven: float
    steepest: float
    better: float
    norm_tolerance: float
    dip_tolerance_rad: float
    memory_s: float


HORIZONTAL, VERTICAL, IRON, HAS, CONFIRMED = 0, 1, 2, 5, 6
FITTING, AGE, TURNED, SMOOTH_HORIZONTAL, SMOOTH_VERTICAL, KNOWN = 7, 8, 9, 10, 11, 12
MONITOR = 13
"""Reference, with its iron's three components; what is known of it; the smoothed field; if iron is known."""

WEIGHT, SQUARE, MISFIT, TURN, BODY, WORLD = 0, 1, 2, 3, 12, 15
CANDIDATE = 18
"""Sums over readings: of weights, squares, misfits, rotations (nine), and fields in both axes."""


@njit(cache=True, nogil=True, error_model="numpy")
def _add(
    sums: FloatArray, memory_s: float, pose: FloatArray, field: FloatArray, misfit: float, s: float
) -> None:
    keep = math.exp(-s / memory_s)
    for k in range(CANDIDATE):
        sums[k] *= keep
    sums[WEIGHT] += s
    sums[SQUARE] += s * (field[0] * field[0] + field[1] * field[1] + field[2] * field[2])
    sums[MISFIT] += s * misfit
    for i in range(3):
        sums[WORLD + i] += s * field[i]
        sums[BODY + i] += s * (field[0] * pose[0, i] + field[1] * pose[1, i] + field[2] * pose[2, i])
        for j in range(3):
            sums[TURN + 3 * i + j] += s * pose[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(sums: FloatArray, prior: float, room: FloatArray, iron: FloatArray) -> float:
    """Fill the room's field and the iron's; return the mean square residual."""
    weight = sums[WEIGHT]
    turn = sums[TURN : TURN + 9].copy().reshape(3, 3) / weight
    body, world = sums[BODY : BODY + 3] / weight, sums[WORLD : WORLD + 3] / weight
    matrix, right = np.empty((3, 3)), np.empty((3, 1))
    for i in range(3):
        right[i, 0] = body[i]
        for k in range(3):
            right[i, 0] -= turn[k, i] * world[k]
        for j in range(3):
            matrix[i, j] = 1.0 + prior if i == j else 0.0
            for k in range(3):
                matrix[i, j] -= turn[k, i] * turn[k, j]
    solve_into(matrix, right)
    rooms = irons = across = 0.0
    for i in range(3):
        iron[i] = right[i, 0]
    for i in range(3):
        turned = turn[i, 0] * iron[0] + turn[i, 1] * iron[1] + turn[i, 2] * iron[2]
        room[i] = world[i] - turned
        rooms += room[i] * room[i]
        irons += iron[i] * iron[i]
        across += room[i] * turned
    return float(max(sums[SQUARE] / weight - rooms - irons - 2.0 * across, 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _room_with(sums: FloatArray, iron: FloatArray, room: FloatArray) -> float:
    """Fill the room's field for a given iron; return the mean square residual."""
    weight = sums[WEIGHT]
    square = sums[SQUARE] / weight
    rooms = 0.0
    for i in range(3):
        turned = 0.0
        for j in range(3):
            turned += sums[TURN + 3 * i + j] / weight * iron[j]
        room[i] = sums[WORLD + i] / weight - turned
        square += iron[i] * iron[i] - 2.0 * iron[i] * sums[BODY + i] / weight
        rooms += room[i] * room[i]
    return float(max(square - rooms, 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _learn(
    monitor: FloatArray, candidate: FloatArray, known: FloatArray, limits: FieldLimits, learnt: FloatArray
) -> bool:
    """Replace the reference if another fits clearly better; fill the room's field of the new one."""
    proved = monitor[CONFIRMED] > 0.0
    after_s = limits.learnt_after_s if proved else limits.first_after_s
    uneven = limits.uneven if proved else limits.first_uneven
    if candidate[WEIGHT] < after_s:
        return False
    room, iron, other = np.empty(3), np.empty(3), np.empty(3)
    left = _solve(candidate, limits.iron_prior, room, iron)
    if left > uneven * uneven * (room[0] * room[0] + room[1] * room[1] + room[2] * room[2]):
        return False
    if 1.5 * candidate[MISFIT] / candidate[WEIGHT] < limits.better * left:
        return False
    if _room_with(candidate, monitor[IRON : IRON + 3], other) < limits.better * left:
        learnt[:] = other
    else:
        learnt[:] = room
        monitor[IRON : IRON + 3] = iron
        known[:] = candidate
        monitor[KNOWN] = 1.0
    monitor[HORIZONTAL], monitor[VERTICAL] = math.hypot(learnt[0], learnt[1]), learnt[2]
    candidate[:] = 0.0
    monitor[FITTING] = monitor[TURNED] = 0.0
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def read_field(
    monitor: FloatArray,
    candidate: FloatArray,
    known: FloatArray,
    limits: FieldLimits,
    pose: FloatArray,
    field: FloatArray,
    rate_rad_s: float,
    duration_s: float,
    clean: FloatArray,
    restart: FloatArray,
) -> tuple[bool, float, bool]:
    """Judge one reading.

    Parameters
    ----------
    monitor, candidate, known : ndarray, shapes (MONITOR,), (CANDIDATE,) and (CANDIDATE,)
        State, changed in place; zeros but for the time of fitting at the start (`fresh_monitor`).
    pose : ndarray, shape (3, 3)
        World from sensor.
    field : ndarray, shape (3,)
        In the world's axes.
    clean, restart : ndarray, shape (3,)
        Filled: the field without iron, and the room's field where the reference was replaced.

    Returns
    -------
    disturbed : bool
    variance : float
        Of the heading, rad^2.
    restarted : bool
        Whether `restart` was filled.
    """
    if monitor[HAS] > 0.0:
        horizontal, vertical = monitor[HORIZONTAL], monitor[VERTICAL]
    else:
        horizontal, vertical = math.hypot(field[0], field[1]), field[2]
        monitor[HAS] = 1.0
    for i in range(3):
        clean[i] = field[i]
        for j in range(3):
            clean[i] -= pose[i, j] * monitor[IRON + j]
    share = 1.0 - math.exp(-duration_s / limits.smoothing_s) if monitor[AGE] != 0.0 else 1.0
    monitor[SMOOTH_HORIZONTAL] += share * (math.hypot(clean[0], clean[1]) - monitor[SMOOTH_HORIZONTAL])
    monitor[SMOOTH_VERTICAL] += share * (clean[2] - monitor[SMOOTH_VERTICAL])
    monitor[AGE] += duration_s
    norm = math.hypot(horizontal, vertical)
    seen = math.hypot(monitor[SMOOTH_HORIZONTAL], monitor[SMOOTH_VERTICAL])
    dip = math.atan2(-monitor[SMOOTH_VERTICAL], monitor[SMOOTH_HORIZONTAL])
    fits = (
        abs(seen - norm) <= limits.norm_tolerance * norm
        and abs(dip - math.atan2(-vertical, horizontal)) <= limits.dip_tolerance_rad
    )
    monitor[FITTING] = monitor[FITTING] + duration_s if fits else 0.0
    across, along = monitor[SMOOTH_HORIZONTAL] - horizontal, monitor[SMOOTH_VERTICAL] - vertical
    off = across * across + along * along
    if monitor[AGE] <= limits.starting_s:
        share = duration_s / monitor[AGE]
    elif monitor[FITTING] < limits.undisturbed_after_s:
        share = 0.0
    else:
        share = duration_s / limits.memory_s
    monitor[HORIZONTAL], monitor[VERTICAL] = horizontal + share * across, vertical + share * along
    restarted = False
    if rate_rad_s > limits.turning_rad_s:
        monitor[TURNED] += duration_s if fits else 0.0
        _add(candidate, limits.memory_s, pose, field, off, duration_s)
        if fits and monitor[KNOWN] > 0.0:
            _add(known, limits.iron_memory_s, pose, field, off, duration_s)
            room, iron = np.empty(3), np.empty(3)
            _solve(known, limits.iron_prior, room, iron)
            monitor[HORIZONTAL], monitor[VERTICAL] = math.hypot(room[0], room[1]), room[2]
            monitor[IRON : IRON + 3] = iron
        restarted = _learn(monitor, candidate, known, limits, restart) and monitor[CONFIRMED] == 0.0
        if monitor[TURNED] > limits.proved_after_s:
            monitor[CONFIRMED] = 1.0
    steep = horizontal <= limits.steepest * norm
    disturbed = steep or monitor[FITTING] < limits.undisturbed_after_s
    variance = math.inf if steep else off / (2.0 * horizontal * horizontal)
    return disturbed, variance, restarted


@njit(cache=True, nogil=True, error_model="numpy")
def judge_fields(
    poses: FloatArray,
    middles: FloatArray,
    fields: FloatArray,
    rates: FloatArray,
    durations: FloatArray,
    backward: bool,
    limits: FieldLimits,
    clean: FloatArray,
    disturbed: FloatArray,
    variance: FloatArray,
) -> None:
    """Judge a stretch's readings in one direction of time, those by a wrong first reference again.

    Parameters
    ----------
    poses, middles : ndarray, shape (n, 3, 3)
        World from sensor at the start of each step, to which the field belongs, and in its middle.
    fields : ndarray, shape (n, 3)
        In the sensor's axes; NaN where there is none.
    rates, durations : ndarray, shape (n,)
    clean, disturbed, variance : ndarray, shapes (n, 3), (n,) and (n,)
        Filled; NaN where there is no reading.
    """
    n = fields.shape[0]
    monitor, candidate, known = np.zeros(MONITOR), np.zeros(CANDIDATE), np.zeros(CANDIDATE)
    monitor[FITTING] = limits.undisturbed_after_s
    field, restart = np.empty(3), np.empty(3)
    wrong = 0
    for turn in range(2):
        for step in range(n if turn == 0 else wrong):
            seen = step if turn == 0 else wrong - 1 - step
            k = n - 1 - seen if backward else seen
            disturbed[k] = variance[k] = math.nan
            if math.isnan(fields[k, 0]):
                clean[k] = math.nan
                continue
            for i in range(3):
                field[i] = (
                    poses[k, i, 0] * fields[k, 0]
                    + poses[k, i, 1] * fields[k, 1]
                    + poses[k, i, 2] * fields[k, 2]
                )
            bad, uncertain, restarted = read_field(
                monitor,
                candidate,
                known,
                limits,
                middles[k],
                field,
                rates[k],
                durations[k],
                clean[k],
                restart,
            )
            disturbed[k], variance[k] = 1.0 if bad else 0.0, uncertain
            if turn == 0 and restarted:
                wrong = seen
