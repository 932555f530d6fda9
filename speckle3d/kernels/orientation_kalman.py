"""Prediction of the orientation filter's covariance, and Kalman's correction."""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation_arrays import (
    BIAS,
    BIAS_WALK,
    CROSS,
    FIELD_PLACE_S,
    FIELD_SD,
    FORCE_NOISE,
    GAIN,
    GYRO_NOISE,
    GYRO_SCALE_NOISE,
    HEADING,
    INNOVATION,
    LEVEL,
    MAGNETIC,
    NOISES,
    NORTH_BIAS,
    RESIDUAL,
    REST_NOISE,
    SHOWS,
    SIZE,
    SPEED,
    STRAY,
    TRANSITION,
    TURNS,
    VECTOR,
    WIDE,
)
from speckle3d.kernels.rotations import apply_into, product_into, solve_into, turn_into

SPEED_ZERO, BIAS_SEEN, NORTH_BIAS_SEEN, NEW_NORTH, NORTH, KINDS = 0, 1, 2, 3, 4, 5
"""Observations, in the order in which a step takes them."""

_ALL, _LEVEL_ONLY, _HEADING_ONLY = 0, 1, 2
"""States that an observation corrects."""


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def predict_covariance(
    p: FloatArray, rate: float, resting: bool, limits: FloatArray, duration: float, work: FloatArray
) -> None:
    """Predict the covariance `p` over one increment by the transition in `work`; fill the noise there."""
    f, wide = work[TRANSITION : TRANSITION + SIZE], work[WIDE : WIDE + SIZE]
    q, size = work[NOISES : NOISES + SIZE], p.shape[0]  # not unrolled
    turning = limits[GYRO_NOISE] * limits[GYRO_NOISE] + (limits[GYRO_SCALE_NOISE] * rate) ** 2
    if resting:
        turning = (limits[REST_NOISE] * limits[GYRO_NOISE]) ** 2
    walk = limits[BIAS_WALK] * limits[BIAS_WALK] * duration
    for i in range(3):
        q[i, i] = turning * duration
        q[i + 3, i + 3] = walk
        q[i + 6, i + 6] = limits[FORCE_NOISE] * limits[FORCE_NOISE] * duration
        if limits[MAGNETIC] > 0.0:
            q[i + 9, i + 9] = q[i + 3, i + 9] = q[i + 9, i + 3] = walk
    q[12, 12] = 0.0
    if limits[MAGNETIC] > 0.0 and not resting:
        q[12, 12] = 2.0 * limits[FIELD_SD] * limits[FIELD_SD] / limits[FIELD_PLACE_S] * duration
    for i in range(size):
        for j in range(size):
            wide[i, j] = f[i, i] * p[i, j]
        for k in range(size):
            factor = f[i, k]
            if k != i and factor != 0.0:
                for j in range(size):
                    wide[i, j] += factor * p[k, j]
    for i in range(size):
        for j in range(size):
            p[i, j] = q[i, j] + f[j, j] * wide[i, j]
    for j in range(size):
        for k in range(size):
            factor = f[j, k]
            if k != j and factor != 0.0:
                for i in range(size):
                    p[i, j] += factor * wide[i, k]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def wrapped(angle: float) -> float:
    """Angle brought into [-pi, pi], as `math.remainder` does."""
    return float(angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi)))


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def update(
    kind: int, variance: float, s: FloatArray, p: FloatArray, magnetic: bool, work: FloatArray
) -> None:
    """Kalman's correction (Joseph's form) by the residuals in `work` of an observation of that kind.

    Where there is a magnetometer, the field corrects the states of the heading alone, and the first copy of
    the bias the others (Schmidt): errors of states left alone count as noise.
    """
    rows, size, corrected = 1 if kind >= NEW_NORTH else 3, p.shape[0], _ALL  # size: not unrolled
    if kind >= NORTH_BIAS_SEEN:
        corrected = _HEADING_ONLY
    elif kind == BIAS_SEEN and magnetic:
        corrected = _LEVEL_ONLY
    shows, cross, gain = work[SHOWS : SHOWS + 3], work[CROSS : CROSS + 3], work[GAIN : GAIN + 3]
    wide, innovation = work[WIDE : WIDE + SIZE], work[INNOVATION : INNOVATION + 3]
    for r in range(rows):
        for j in range(size):
            cross[r, j] = 0.0
        for k in range(size):
            factor = shows[r, k]
            if factor != 0.0:
                for j in range(size):
                    cross[r, j] += factor * p[k, j]
    for r in range(rows):
        for t in range(rows):
            total = variance if r == t else 0.0
            for k in range(size):
                total += cross[r, k] * shows[t, k]
            innovation[r, t] = total
        for j in range(size):
            gain[r, j] = cross[r, j]
    solve_into(innovation, gain[:rows])
    for j in range(size):
        north = j == 2 or j >= 9
        if corrected != _ALL and north != (corrected == _HEADING_ONLY):
            for r in range(rows):
                gain[r, j] = 0.0
    for i in range(size):
        for j in range(size):
            total = p[i, j]
            for r in range(rows):
                total -= gain[r, i] * cross[r, j]
            wide[i, j] = total
    for i in range(size):
        for r in range(rows):
            total = -variance * gain[r, i]
            for k in range(size):
                total += wide[i, k] * shows[r, k]
            cross[r, i] = total
    for i in range(size):
        for j in range(size):
            total = wide[i, j]
            for r in range(rows):
                total -= cross[r, i] * gain[r, j]
            p[i, j] = total
    _inject(rows, s, magnetic, work)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _inject(rows: int, s: FloatArray, magnetic: bool, work: FloatArray) -> None:
    """Apply the estimated error to the state."""
    error, turn = work[VECTOR], work[TURNS]
    level, speed = s[LEVEL : LEVEL + 9], s[SPEED : SPEED + 3]
    for j in range(SIZE):
        error[j] = 0.0
        for r in range(rows):
            error[j] += work[GAIN + r, j] * work[RESIDUAL, r]
    if magnetic:
        s[HEADING] = wrapped(s[HEADING] + error[2])
        error[2] = 0.0
    turn_into(error[0], error[1], error[2], turn)
    product_into(turn, level, level)
    apply_into(turn, speed, speed)
    for i in range(3):
        speed[i] += error[6 + i]
        s[BIAS + i] += error[3 + i]
        s[NORTH_BIAS + i] += error[9 + i]
    s[STRAY] += error[12]
