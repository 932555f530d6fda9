"""The angle from level axes, carried by the gyroscope, to magnetic north: a Kalman filter per model.

`xsens.fusion.heading` says what is done and why; arrays are laid out in `heading_arrays`.
"""

import math

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.orientation.heading_arrays import (
    AFTER_S,
    BEGUN,
    BIAS_CHANGE,
    BIAS_S,
    BIAS_VARIANCE,
    CORRECTION,
    EVIDENCE,
    FIRST_PLACE,
    FIRST_STRAY,
    FOUND_TURN,
    FOUND_VARIANCE,
    FREEDOM,
    GYRO_BIAS,
    HOLD_S,
    HOLDING,
    IRON,
    IRON_JUMP,
    IRON_PRIOR,
    LAG_S,
    LATE,
    MOVED,
    OF_LAG,
    OF_PLACE,
    OF_ROOM,
    OF_STRAY,
    OUTLIER,
    PLACE,
    POSE,
    RAN,
    READING,
    RESTED,
    RESTS,
    ROOM,
    ROOM_WALK,
    SEEN,
    SLIP,
    SPAN,
    STATES,
    STRAY,
    STRAY_S,
    TILT,
    TRUST,
    WHITE,
)
from speckle3d.kernels.orientation.rotations import sparse_product_into


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
        Constants of all models.
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
                _expect(x, row, rows, off)
                _spread(x, p, row, shared, rows, cross, total)
                misfit, _ = _inverted(total, 0.0, off, inverse)
                if misfit > shared[OUTLIER] and model[IRON_JUMP] > 0.0 and flag[HOLDING] <= 0.0:
                    flag[HOLDING] = shared[HOLD_S]
                    _iron_changes(p, model)
                    _spread(x, p, row, shared, rows, cross, total)
            if keeps:
                kept_predicted[k, j] = p
            if row[SEEN] > 0.0:
                _correct(x, p, shared, off, cross, gain, total, inverse, out)
            for first in (OF_ROOM, OF_PLACE, OF_STRAY):
                _follow_correction(x, p, row, first)
            out[FOUND_TURN], out[FOUND_VARIANCE] = turn_to_north(x, p)
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
def turn_to_north(x: FloatArray, p: FloatArray) -> tuple[float, float]:
    """Angle about up from the level axes to north, by the room's field, and its variance."""
    across, along = x[OF_ROOM], x[OF_ROOM + 1]
    square = across * across + along * along
    unknown = math.pi * math.pi
    if square == 0.0:
        return 0.0, unknown
    variance = along * along * p[OF_ROOM, OF_ROOM] + across * across * p[OF_ROOM + 1, OF_ROOM + 1]
    variance = (variance - 2.0 * across * along * p[OF_ROOM, OF_ROOM + 1]) / (square * square)
    return -math.atan2(along, across), min(max(variance, 0.0), unknown)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _begin(
    x: FloatArray, p: FloatArray, flag: FloatArray, row: FloatArray, model: FloatArray, shared: FloatArray
) -> None:
    """Begin with the bin's reading; after a pause with the iron and lag found so far."""
    if flag[RAN] == 0.0:
        _forget(x, p, IRON, 3, model[IRON_PRIOR])
        _forget(x, p, OF_LAG, 1, shared[LAG_S])
    _forget(x, p, OF_ROOM, 3, shared[ROOM])
    _forget(x, p, GYRO_BIAS, 3, math.sqrt(row[BIAS_VARIANCE]))
    _forget(x, p, OF_PLACE, 3, shared[FIRST_PLACE] if flag[RAN] == 0.0 else shared[PLACE])
    _forget(x, p, OF_STRAY, 3, shared[FIRST_STRAY] * model[STRAY])
    for i in range(3):
        x[OF_ROOM + i] = row[READING + i]
        for j in range(3):
            x[OF_ROOM + i] -= row[POSE + 3 * i + j] * x[IRON + j]
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
    _slip(x, p, row[SLIP])
    if not resting:
        _turn(x, p, row)
        _decay(x, p, OF_STRAY, math.exp(-span / model[STRAY_S]), model[STRAY] ** 2)
    for i in range(OF_ROOM, OF_ROOM + 3):
        p[i, i] += shared[ROOM_WALK] ** 2 * span
    if flag[HOLDING] > 0.0:
        flag[HOLDING] -= span
        _iron_changes(p, model)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _follow_correction(x: FloatArray, p: FloatArray, row: FloatArray, first: int) -> None:
    """Turn a field as the level axes were turned by corrections of their tilt: it stays where it was."""
    turn = row[CORRECTION : CORRECTION + 9]
    a, b, c = x[first], x[first + 1], x[first + 2]
    for i in range(3):
        x[first + i] = turn[3 * i] * a + turn[3 * i + 1] * b + turn[3 * i + 2] * c
    for j in range(STATES):
        a, b, c = p[first, j], p[first + 1, j], p[first + 2, j]
        for i in range(3):
            p[first + i, j] = turn[3 * i] * a + turn[3 * i + 1] * b + turn[3 * i + 2] * c
    for j in range(STATES):
        a, b, c = p[j, first], p[j, first + 1], p[j, first + 2]
        for i in range(3):
            p[j, first + i] = turn[3 * i] * a + turn[3 * i + 1] * b + turn[3 * i + 2] * c


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _turn(x: FloatArray, p: FloatArray, row: FloatArray) -> None:
    """Turn the room's field as the gyroscope's bias turns the level axes."""
    angle = 0.0
    across, along = x[OF_ROOM], x[OF_ROOM + 1]
    for i in range(3):
        rate = row[POSE + 6 + i] * row[SPAN]
        angle += rate * x[GYRO_BIAS + i]
        for j in range(STATES):
            p[OF_ROOM, j] -= rate * along * p[GYRO_BIAS + i, j]
            p[OF_ROOM + 1, j] += rate * across * p[GYRO_BIAS + i, j]
    for j in range(STATES):
        covariance = 0.0
        for i in range(3):
            covariance += row[POSE + 6 + i] * row[SPAN] * p[j, GYRO_BIAS + i]
        p[j, OF_ROOM] -= along * covariance
        p[j, OF_ROOM + 1] += across * covariance
    x[OF_ROOM] -= angle * along
    x[OF_ROOM + 1] += angle * across


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _slip(x: FloatArray, p: FloatArray, variance: float) -> None:
    """Let the level axes slip about up by as much, rad^2."""
    across, along = x[OF_ROOM], x[OF_ROOM + 1]
    p[OF_ROOM, OF_ROOM] += variance * along * along
    p[OF_ROOM + 1, OF_ROOM + 1] += variance * across * across
    p[OF_ROOM, OF_ROOM + 1] -= variance * across * along
    p[OF_ROOM + 1, OF_ROOM] -= variance * across * along


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _iron_changes(p: FloatArray, model: FloatArray) -> None:
    """Let the iron on the sensor be another: some is put on, or taken off."""
    for i in range(IRON, IRON + 3):
        p[i, i] += model[IRON_JUMP] ** 2


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _expect(x: FloatArray, row: FloatArray, rows: FloatArray, off: FloatArray) -> None:
    """Fill the derivatives of the field in the level axes, and how far it is from that expected.

    Of fields only that of the room is turned by errors of the heading: place and stray have random
    directions, and turned they are as likely; a linear filter would take their turns for knowledge of it.
    """
    for i in range(3):
        for j in range(STATES):
            rows[i, j] = 0.0
        rows[i, OF_ROOM + i] = rows[i, OF_PLACE + i] = rows[i, OF_STRAY + i] = 1.0
        rows[i, OF_LAG] = row[LATE + i]
        for j in range(3):
            rows[i, IRON + j] = row[POSE + 3 * i + j]
        off[i] = row[READING + i]
        for j in range(STATES):
            off[i] -= rows[i, j] * x[j]


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _spread(
    x: FloatArray,
    p: FloatArray,
    row: FloatArray,
    shared: FloatArray,
    rows: FloatArray,
    cross: FloatArray,
    total: FloatArray,
) -> None:
    """Fill the covariance of the expected field with the state, and its own.

    Its own holds the reading's noise, and what the level axes' tilt makes of the field.
    """
    sparse_product_into(rows, p, cross)
    for i in range(3):
        for k in range(3):
            value = 0.0
            for m in range(STATES):
                value += cross[i, m] * rows[k, m]
            total[i, k] = value
    white = shared[WHITE] * shared[WHITE] / row[SPAN]
    across, along, up = x[OF_ROOM], x[OF_ROOM + 1], x[OF_ROOM + 2]
    total[0, 0] += white + row[TILT] * up * up
    total[1, 1] += white + row[TILT] * up * up
    total[2, 2] += white + row[TILT] * (across * across + along * along)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _inverted(
    total: FloatArray, variance: float, off: FloatArray, inverse: FloatArray
) -> tuple[float, float]:
    """Fill the inverse of the covariance with more noise; return the squared misfit and the determinant."""
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
    shared: FloatArray,
    off: FloatArray,
    cross: FloatArray,
    gain: FloatArray,
    total: FloatArray,
    inverse: FloatArray,
    out: FloatArray,
) -> None:
    """Correct by a reading, the less the less likely it is: its errors have Student's distribution."""
    freedom = shared[FREEDOM]
    misfit, determinant = _inverted(total, 0.0, off, inverse)
    density = math.lgamma(0.5 * (freedom + 3.0)) - math.lgamma(0.5 * freedom) - 1.5 * math.log(freedom)
    out[EVIDENCE] = density - 0.5 * math.log(determinant)
    out[EVIDENCE] -= 0.5 * (freedom + 3.0) * math.log(1.0 + misfit / freedom)
    trust = (freedom + 3.0) / (freedom + misfit)
    if trust < 1.0:
        mean = (total[0, 0] + total[1, 1] + total[2, 2]) / 3.0
        _inverted(total, (1.0 / trust - 1.0) * mean, off, inverse)
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
