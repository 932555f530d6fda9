"""The angle from level axes, carried by the gyroscope, to magnetic north: a Kalman filter per model.

`xsens.fusion.heading` says what is done and why; arrays are laid out in `heading_arrays`.
"""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.heading_arrays import (
    AFTER_S,
    BEGUN,
    BIAS_CHANGE,
    BIAS_S,
    BIAS_VARIANCE,
    DOWN_FIELD,
    EVIDENCE,
    FIRST_PLACE,
    FOUND_TURN,
    FOUND_VARIANCE,
    FREEDOM,
    GYRO,
    GYRO_BIAS,
    GYRO_SCALE,
    HOLD_S,
    HOLDING,
    IRON,
    IRON_JUMP,
    IRON_PRIOR,
    LAG_S,
    LATE,
    LEVEL_FIELD,
    MOVED,
    OF_LAG,
    OF_PLACE,
    OF_STRAY,
    OUTLIER,
    PLACE,
    POSE,
    RAN,
    READING,
    REST_GYRO,
    RESTED,
    RESTS,
    ROOM,
    ROOM_WALK,
    SEEN,
    SPAN,
    STATES,
    STEEPEST,
    STRAY,
    STRAY_S,
    TRUST,
    TURN,
    TURNING,
    WHITE,
)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def find_headings(
    bins: FloatArray,
    models: FloatArray,
    shared: FloatArray,
    means: FloatArray,
    covariances: FloatArray,
    flags: FloatArray,
    found: FloatArray,
    kept_means: FloatArray,
    kept: FloatArray,
    kept_predicted: FloatArray,
) -> None:
    """Run every model's filter over the bins.

    Parameters
    ----------
    bins : ndarray, shape (n, BIN)
    models : ndarray, shape (m, MODEL)
    shared : ndarray, shape (SHARED,)
    means, covariances, flags : ndarray, shapes (m, STATES), (m, STATES, STATES) and (m, FLAGS)
        The filters, zeros at first; changed in place.
    found : ndarray, shape (n, m, FOUND)
        Filled.
    kept_means, kept, kept_predicted : ndarray, shapes (n, m, STATES) and (n, m, STATES, STATES), or n = 0
        Filled: state and covariance after each bin, and covariance before its reading.
    """
    rows, cross, gain = np.zeros((3, STATES)), np.zeros((3, STATES)), np.zeros((3, STATES))
    off, total, inverse = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    keeps = kept_means.shape[0] > 0
    for j in range(models.shape[0]):
        x, p, flag, model = means[j], covariances[j], flags[j], models[j]
        for k in range(bins.shape[0]):
            row, out = bins[k], found[k, j]
            flag[MOVED] += 0.0 if row[RESTS] > 0.0 else row[SPAN]
            out[EVIDENCE], out[TRUST] = math.nan, 0.0
            if flag[BEGUN] == 0.0 and row[SEEN] > 0.0 and flag[MOVED] >= model[AFTER_S]:
                _begin(x, p, flag, row, model, shared)
            if flag[BEGUN] == 0.0:
                out[FOUND_TURN], out[FOUND_VARIANCE] = 0.0, math.pi * math.pi
                continue
            _predict(x, p, flag, row, model, shared)
            if row[SEEN] > 0.0:
                _expect(x, row, shared, rows, off)
                _spread(p, rows, cross, total)
                misfit, _ = _inverted(total, shared[WHITE] * shared[WHITE] / row[SPAN], off, inverse)
                if misfit > shared[OUTLIER] and model[IRON_JUMP] > 0.0 and flag[HOLDING] <= 0.0:
                    _iron_changes(p, flag, model, shared)
                    _spread(p, rows, cross, total)
            if keeps:
                kept_predicted[k, j] = p
            if row[SEEN] > 0.0:
                _correct(x, p, row, shared, off, cross, gain, total, inverse, out)
            out[FOUND_TURN], out[FOUND_VARIANCE] = x[TURN], p[TURN, TURN]
            if keeps:
                kept_means[k, j], kept[k, j] = x, p


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _forget(x: FloatArray, p: FloatArray, first: int, count: int, sd: float) -> None:
    """Set states anew, to zero with that deviation."""
    for i in range(first, first + count):
        x[i] = 0.0
        for j in range(STATES):
            p[i, j] = p[j, i] = 0.0
        p[i, i] = sd * sd


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _begin(
    x: FloatArray, p: FloatArray, flag: FloatArray, row: FloatArray, model: FloatArray, shared: FloatArray
) -> None:
    """Begin with the bin's reading; after a pause with the room, iron and lag found so far."""
    if flag[RAN] == 0.0:
        _forget(x, p, IRON, 3, model[IRON_PRIOR])
        _forget(x, p, LEVEL_FIELD, 2, shared[ROOM])
        _forget(x, p, OF_LAG, 1, shared[LAG_S])
        x[LEVEL_FIELD], x[DOWN_FIELD] = math.hypot(row[READING], row[READING + 1]), row[READING + 2]
    _forget(x, p, TURN, 1, math.pi)
    _forget(x, p, GYRO_BIAS, 3, math.sqrt(row[BIAS_VARIANCE]))
    _forget(x, p, OF_PLACE, 3, shared[FIRST_PLACE] if flag[RAN] == 0.0 else shared[PLACE])
    _forget(x, p, OF_STRAY, 3, model[STRAY])
    across, along = row[READING], row[READING + 1]
    for i in range(3):
        across -= row[POSE + i] * x[IRON + i]
        along -= row[POSE + 3 + i] * x[IRON + i]
    x[TURN] = -math.atan2(along, across)
    flag[BEGUN] = flag[RAN] = 1.0
    flag[RESTED], flag[HOLDING] = row[RESTS], 0.0


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _decay(x: FloatArray, p: FloatArray, first: int, keep: float, variance: float) -> None:
    """Let three states fade, and wander by as much."""
    for i in range(first, first + 3):
        x[i] *= keep
        for j in range(STATES):
            p[i, j] *= keep
        for j in range(STATES):
            p[j, i] *= keep
        p[i, i] += (1.0 - keep * keep) * variance


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _predict(
    x: FloatArray, p: FloatArray, flag: FloatArray, row: FloatArray, model: FloatArray, shared: FloatArray
) -> None:
    """Predict over a bin."""
    span, resting = row[SPAN], row[RESTS] > 0.0
    if row[RESTS] != flag[RESTED]:
        _forget(x, p, OF_PLACE, 3, shared[PLACE])
        flag[RESTED] = row[RESTS]
    for i in range(3):
        x[GYRO_BIAS + i] -= row[BIAS_CHANGE + i]
    _decay(x, p, GYRO_BIAS, math.exp(-span / shared[BIAS_S]), row[BIAS_VARIANCE])
    if resting:
        p[TURN, TURN] += shared[REST_GYRO] ** 2 * span
    else:
        for i in range(3):
            factor = -row[POSE + 6 + i] * span
            x[TURN] += factor * x[GYRO_BIAS + i]
            for j in range(STATES):
                p[TURN, j] += factor * p[GYRO_BIAS + i, j]
        for j in range(STATES):
            total = p[j, TURN]
            for i in range(3):
                total -= row[POSE + 6 + i] * span * p[j, GYRO_BIAS + i]
            p[j, TURN] = total
        p[TURN, TURN] += (shared[GYRO] ** 2 + shared[GYRO_SCALE] ** 2 * row[TURNING]) * span
        _decay(x, p, OF_STRAY, math.exp(-span / model[STRAY_S]), model[STRAY] ** 2)
    for i in range(2):
        p[LEVEL_FIELD + i, LEVEL_FIELD + i] += shared[ROOM_WALK] ** 2 * span
    if flag[HOLDING] > 0.0:
        flag[HOLDING] -= span
        for i in range(IRON, IRON + 3):
            p[i, i] += model[IRON_JUMP] ** 2


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _iron_changes(p: FloatArray, flag: FloatArray, model: FloatArray, shared: FloatArray) -> None:
    """Iron is put on, or taken off, from now on for a while."""
    flag[HOLDING] = shared[HOLD_S]
    for i in range(IRON, IRON + 3):
        p[i, i] += model[IRON_JUMP] ** 2


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _expect(x: FloatArray, row: FloatArray, shared: FloatArray, rows: FloatArray, off: FloatArray) -> None:
    """Fill the derivatives of the field in the world's axes, and how far it is from that expected."""
    c, s = math.cos(x[TURN]), math.sin(x[TURN])
    for i in range(3):
        off[i] = row[READING + i] - row[LATE + i] * x[OF_LAG]
        for j in range(3):
            off[i] -= row[POSE + 3 * i + j] * x[IRON + j]
        for j in range(STATES):
            rows[i, j] = 0.0
        rows[i, OF_PLACE + i] = rows[i, OF_STRAY + i] = 1.0
    across, along = c * off[0] - s * off[1], s * off[0] + c * off[1]
    off[0] = across - x[LEVEL_FIELD] - x[OF_PLACE] - x[OF_STRAY]
    off[1] = along - x[OF_PLACE + 1] - x[OF_STRAY + 1]
    off[2] -= x[DOWN_FIELD] + x[OF_PLACE + 2] + x[OF_STRAY + 2]
    if abs(x[LEVEL_FIELD]) > shared[STEEPEST]:
        rows[0, TURN], rows[1, TURN] = along, -across
    for j in range(4):
        to = IRON + j if j < 3 else OF_LAG
        at, stride = (POSE + j, 3) if j < 3 else (LATE, 1)
        east, north = row[at], row[at + stride]
        rows[0, to], rows[1, to] = c * east - s * north, s * east + c * north
        rows[2, to] = row[at + 2 * stride]
    rows[0, LEVEL_FIELD] = rows[2, DOWN_FIELD] = 1.0


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _spread(p: FloatArray, rows: FloatArray, cross: FloatArray, total: FloatArray) -> None:
    """Fill the covariance of the expected field with the state, and its own."""
    for i in range(3):
        for j in range(STATES):
            cross[i, j] = 0.0
        for m in range(STATES):
            factor = rows[i, m]
            if factor != 0.0:
                for j in range(STATES):
                    cross[i, j] += factor * p[m, j]
    for i in range(3):
        for k in range(3):
            value = 0.0
            for m in range(STATES):
                value += cross[i, m] * rows[k, m]
            total[i, k] = value


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _inverted(
    total: FloatArray, variance: float, off: FloatArray, inverse: FloatArray
) -> tuple[float, float]:
    """Fill the inverse of the covariance with that noise; return the squared misfit and the determinant."""
    a, d, f = total[0, 0] + variance, total[1, 1] + variance, total[2, 2] + variance
    b, c, e = total[0, 1], total[0, 2], total[1, 2]
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = d * f - e * e, a * f - c * c, a * d - b * b
    inverse[0, 1] = inverse[1, 0] = c * e - b * f
    inverse[0, 2] = inverse[2, 0] = b * e - c * d
    inverse[1, 2] = inverse[2, 1] = b * c - a * e
    determinant = a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]
    misfit = 0.0
    for i in range(3):
        for k in range(3):
            inverse[i, k] /= determinant
            misfit += off[i] * inverse[i, k] * off[k]
    return misfit, determinant


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _correct(
    x: FloatArray,
    p: FloatArray,
    row: FloatArray,
    shared: FloatArray,
    off: FloatArray,
    cross: FloatArray,
    gain: FloatArray,
    total: FloatArray,
    inverse: FloatArray,
    out: FloatArray,
) -> None:
    """Correct by a reading, the less the less likely it is: its errors have Student's distribution."""
    freedom, variance = shared[FREEDOM], shared[WHITE] * shared[WHITE] / row[SPAN]
    misfit, determinant = _inverted(total, variance, off, inverse)
    density = math.lgamma(0.5 * (freedom + 3.0)) - math.lgamma(0.5 * freedom) - 1.5 * math.log(freedom)
    out[EVIDENCE] = density - 0.5 * math.log(determinant)
    out[EVIDENCE] -= 0.5 * (freedom + 3.0) * math.log(1.0 + misfit / freedom)
    trust = (freedom + 3.0) / (freedom + misfit)
    if trust < 1.0:
        mean = (total[0, 0] + total[1, 1] + total[2, 2]) / 3.0 + variance
        _inverted(total, variance + (1.0 / trust - 1.0) * mean, off, inverse)
    out[TRUST] = min(trust, 1.0)
    for j in range(STATES):
        for i in range(3):
            value = 0.0
            for k in range(3):
                value += inverse[i, k] * cross[k, j]
            gain[i, j] = value
            x[j] += value * off[i]
    for i in range(STATES):
        for j in range(i + 1):
            value = p[i, j]
            for k in range(3):
                value -= gain[k, i] * cross[k, j]
            p[i, j] = p[j, i] = value
