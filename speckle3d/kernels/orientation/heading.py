"""The angle from level axes, carried by the gyroscope, to magnetic north: a Kalman filter of the field.

`xsens.fusion.heading` says what is done and why.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from speckle3d.core.arrays import FloatArray

ROOM, BIAS, IRON, PLACE, STRAY, LAG, SIZE = 0, 3, 6, 9, 12, 15, 16
"""Places in the state: the room's field (level axes), what is left of the gyroscope's bias (sensor axes), the
field of iron on the sensor (sensor axes), what the place adds to the room's and the stray (level axes), each
three numbers, and the magnetometer's lag, s. Fields are fractions of the field's norm."""

BIN = np.dtype(
    [
        ("span_s", "f8"),  # sum of its steps
        ("resting", "?"),
        ("seen", "?"),  # whether it has a reading of the field
        ("slip_rad2", "f8"),  # variance of the level axes' turn about up
        ("bias_variance", "f8"),  # of the gyroscope, rad^2/s^2
        ("bias_change", "f8", 3),  # by which the filter of inclination changed it, rad/s
        ("field", "f8", 3),  # mean in the level axes
        ("field_rate", "f8", 3),  # its derivative by the magnetometer's lag, 1/s
        ("level", "f8", (3, 3)),  # mean level axes from the sensor's
        ("tilt_rad2", "f8"),  # variance of the level axes' tilt
        ("correction", "f8", (3, 3)),  # turn by which corrections of the tilt turned the level axes
    ],
    align=True,
)
"""A quarter of a second of the sensor's movement."""

ROOMS = np.dtype(
    [
        ("stray", "f8"),
        ("least_stray", "f8"),
        ("most_stray", "f8"),
        ("first_stray", "f8"),
        ("stray_s", "f8"),
        ("adapts_s", "f8"),
        ("place", "f8"),
        ("first_place", "f8"),
        ("white_sqrt_s", "f8"),
        ("bias_s", "f8"),
        ("walk_sqrt_s", "f8"),
        ("lag_s", "f8"),
        ("freedom", "f8"),
        ("outlier", "f8"),
        ("hold_s", "f8"),
    ]
)
"""What all models share: see `xsens.fusion.heading`."""

KEPT = np.dtype(
    [
        ("x", "f8", SIZE),
        ("p", "f8", (SIZE, SIZE)),
        ("stray", "f8"),  # deviation now
        ("begun", "?"),  # in this stretch
        ("ran", "?"),  # ever
        ("rested", "?"),  # in the last bin
        ("holding_s", "f8"),  # how long iron is still being put on
        ("iron", "f8"),  # deviation of the iron at the start
        ("iron_put_on", "f8"),  # of iron put on later, zero if none ever is
    ],
    align=True,
)
"""One model's filter."""

FOUND = np.dtype([(name, "f8") for name in ("turn_rad", "variance", "evidence", "trust", "stray")])
"""Angle from the level axes to north at the end of a bin, and its variance; logarithm of the density of the
reading, NaN without one; its weight, 0 to 1; deviation of the stray."""

_ADAPTED = 1.5
"""Fisher's information on the logarithm of a variance that one vector gives."""

_LARGEST_SCORE, _LARGEST_CHANGE = 50.0, 0.5
"""Bounds of a reading's squared misfit, and of the change of that logarithm, in one bin."""


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def find_headings(
    bins: Any,
    room: Any,
    kept: Any,
    found: Any,
    states: FloatArray,
    covariances: FloatArray,
    transitions: FloatArray,
    noises: FloatArray,
) -> None:
    """Run one model's filter over bins.

    Parameters
    ----------
    bins : structured ndarray, shape (n,), of `BIN`
    room : structured ndarray, shape (1,), of `ROOMS`
    kept : structured ndarray, shape (1,), of `KEPT`
        The filter, changed in place.
    found : structured ndarray, shape (n,), of `FOUND`
        Filled.
    states, covariances, transitions, noises : ndarray, shapes (n, SIZE) and (n, SIZE, SIZE), or n = 0
        Filled: after each bin, and from the one before to it.
    """
    s, r = kept[0], room[0]
    rows, transition, noise = np.zeros((3, SIZE)), np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE))
    for k in range(bins.shape[0]):
        b, out = bins[k], found[k]
        out.evidence, out.trust, out.turn_rad, out.variance = math.nan, 0.0, 0.0, math.pi**2
        out.stray = s.stray
        if not s.begun and b.seen:
            _begin(s, b, r)
        if not s.begun:
            continue
        _predict(s, b, r, transition, noise)
        if b.seen:
            _correct(s, b, r, rows, noise, out)
        for first in (ROOM, PLACE, STRAY):  # fields stay where they are as the level axes are corrected
            s.x[first : first + 3] = b.correction @ s.x[first : first + 3]
            _turn_rows(s.p, first, b.correction)
            _turn_rows(s.p.T, first, b.correction)
        out.turn_rad, out.variance = turn_to_north(s.x, s.p)
        if states.shape[0] > 0:
            states[k], covariances[k], transitions[k], noises[k] = s.x, s.p, transition, noise


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _turn_rows(p: FloatArray, first: int, turn: FloatArray) -> None:
    """Turn three rows of a covariance as one vector."""
    for j in range(SIZE):
        x, y, z = p[first, j], p[first + 1, j], p[first + 2, j]
        for i in range(3):
            p[first + i, j] = turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _add_turn(p: FloatArray, rates: FloatArray, across: float, along: float) -> None:
    """Add to the rows of the room's field what those of the bias turn it by."""
    for j in range(SIZE):
        angle = rates[0] * p[BIAS, j] + rates[1] * p[BIAS + 1, j] + rates[2] * p[BIAS + 2, j]
        p[ROOM, j] -= along * angle
        p[ROOM + 1, j] += across * angle


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def turn_to_north(x: FloatArray, p: FloatArray) -> tuple[float, float]:
    """Angle about up from the level axes to north, by the room's field, and its variance."""
    across, along = x[ROOM], x[ROOM + 1]
    square = across * across + along * along
    if square == 0.0:
        return 0.0, math.pi**2
    variance = along * along * p[0, 0] + across * across * p[1, 1] - 2.0 * across * along * p[0, 1]
    return -math.atan2(along, across), min(max(variance / (square * square), 0.0), math.pi**2)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _begin(s: Any, b: Any, r: Any) -> None:
    """Begin with the bin's reading; after a pause with the iron and lag found so far."""
    place = r.place if s.ran else r.first_place
    if not s.ran:
        _forget(s, IRON, 3, s.iron)
        _forget(s, LAG, 1, r.lag_s)
        s.stray = r.stray
    _forget(s, ROOM, 3, 1.0)
    _forget(s, BIAS, 3, math.sqrt(b.bias_variance))
    _forget(s, PLACE, 3, place)
    _forget(s, STRAY, 3, r.first_stray * s.stray)
    s.x[ROOM : ROOM + 3] = b.field - b.level @ s.x[IRON : IRON + 3]
    s.begun, s.ran, s.rested, s.holding_s = True, True, b.resting, 0.0


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _forget(s: Any, first: int, count: int, sd: float) -> None:
    """Set states anew, to zero with that deviation."""
    for i in range(first, first + count):
        s.x[i], s.p[i], s.p[:, i] = 0.0, 0.0, 0.0
        s.p[i, i] = sd * sd


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _predict(s: Any, b: Any, r: Any, f: FloatArray, q: FloatArray) -> None:
    """Predict over a bin; fill its transition and noise."""
    span, across, along = b.span_s, s.x[ROOM], s.x[ROOM + 1]
    moving = 0.0 if b.resting else 1.0
    keep_bias, keep_stray = math.exp(-span / r.bias_s), math.exp(-moving * span / r.stray_s)
    stays = 1.0 if b.resting == s.rested else 0.0
    s.rested = b.resting
    s.x[BIAS : BIAS + 3] -= b.bias_change
    f[:], q[:] = 0.0, 0.0
    f[LAG, LAG] = 1.0
    for i in range(3):
        turn = moving * span * keep_bias * b.level[2, i]
        f[ROOM, BIAS + i], f[ROOM + 1, BIAS + i] = -turn * along, turn * across
        f[ROOM + i, ROOM + i] = f[IRON + i, IRON + i] = 1.0
        f[BIAS + i, BIAS + i], f[PLACE + i, PLACE + i], f[STRAY + i, STRAY + i] = keep_bias, stays, keep_stray
        q[ROOM + i, ROOM + i] = r.walk_sqrt_s**2 * span
        q[BIAS + i, BIAS + i] = (1.0 - keep_bias**2) * b.bias_variance
        q[IRON + i, IRON + i] = s.iron_put_on**2 if s.holding_s > 0.0 else 0.0
        q[PLACE + i, PLACE + i] = (1.0 - stays) * r.place**2
        q[STRAY + i, STRAY + i] = (1.0 - keep_stray**2) * s.stray**2
    q[ROOM, ROOM] += b.slip_rad2 * along * along
    q[ROOM + 1, ROOM + 1] += b.slip_rad2 * across * across
    q[ROOM, ROOM + 1] = q[ROOM + 1, ROOM] = -b.slip_rad2 * across * along
    s.holding_s = max(s.holding_s - span, 0.0)
    s.x[:] = f @ s.x
    for i in range(SIZE):
        for j in range(SIZE):
            s.p[i, j] *= f[i, i] * f[j, j]
    rates = moving * span * b.level[2]
    _add_turn(s.p, rates, across, along)
    _add_turn(s.p.T, rates, across, along)
    s.p += q


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _correct(s: Any, b: Any, r: Any, rows: FloatArray, q: FloatArray, out: Any) -> None:
    """Correct by a reading, the less the less likely it is: its errors have Student's distribution.

    Of fields only that of the room is turned by errors of the heading: place and stray have random
    directions, and turned they are as likely; a linear filter would take their turns for knowledge of it.
    """
    for i in range(3):
        rows[i, ROOM + i] = rows[i, PLACE + i] = rows[i, STRAY + i] = 1.0
        rows[i, LAG] = b.field_rate[i]
        rows[i, IRON : IRON + 3] = b.level[i]
    off = b.field - rows @ s.x
    cross, total = _spread(s, b, r, rows)
    inverse, determinant = _inverse(total)
    misfit = off @ (inverse @ off)
    if misfit > r.outlier and s.iron_put_on > 0.0 and s.holding_s <= 0.0:
        s.holding_s = r.hold_s
        for i in range(IRON, IRON + 3):
            s.p[i, i] += s.iron_put_on**2
            q[i, i] += s.iron_put_on**2
        cross, total = _spread(s, b, r, rows)
        inverse, determinant = _inverse(total)
        misfit = off @ (inverse @ off)
    if not b.resting:
        _adapt(s, b, r, off, misfit, inverse)
    v = r.freedom
    density = math.lgamma(0.5 * (v + 3.0)) - math.lgamma(0.5 * v) - 1.5 * math.log(v)
    out.evidence = density - 0.5 * math.log(determinant) - 0.5 * (v + 3.0) * math.log(1.0 + misfit / v)
    out.trust = min((v + 3.0) / (v + misfit), 1.0)
    if out.trust < 1.0:
        more = (1.0 / out.trust - 1.0) * (total[0, 0] + total[1, 1] + total[2, 2]) / 3.0
        for i in range(3):
            total[i, i] += more
        inverse, _ = _inverse(total)
    gain = cross @ inverse
    s.x[:] += gain @ off
    p = s.p - gain @ cross.T
    s.p[:] = 0.5 * (p + p.T)


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _inverse(m: FloatArray) -> tuple[FloatArray, float]:
    """Inverse of a symmetric matrix, shape (3, 3), and its determinant."""
    out = np.empty((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for n in range(3):
            o, p = (n + 1) % 3, (n + 2) % 3
            out[i, n] = m[j, o] * m[k, p] - m[j, p] * m[k, o]
    determinant = m[0, 0] * out[0, 0] + m[0, 1] * out[0, 1] + m[0, 2] * out[0, 2]
    return out / determinant, determinant


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _spread(s: Any, b: Any, r: Any, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance of the state with the expected field, and that of the reading.

    The reading's holds its noise, and what the level axes' tilt makes of the field.
    """
    cross = s.p @ rows.T
    total = rows @ cross
    across, up = s.x[ROOM] ** 2 + s.x[ROOM + 1] ** 2, s.x[ROOM + 2] ** 2
    for i in range(3):
        total[i, i] += r.white_sqrt_s**2 / b.span_s + b.tilt_rad2 * (up if i < 2 else across)
    return cross, total


@njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _adapt(s: Any, b: Any, r: Any, off: FloatArray, misfit: float, inverse: FloatArray) -> None:
    """Follow the stray's variance by the slope of the reading's likelihood: the room may become another."""
    weighted = inverse @ off
    believed = min(1.0, _LARGEST_SCORE / misfit)
    score = 0.0
    for i in range(3):
        score += 0.5 * s.p[STRAY + i, STRAY + i] * (believed * weighted[i] ** 2 - inverse[i, i])
    change = score * b.span_s / (_ADAPTED * r.adapts_s)
    s.stray *= math.exp(0.5 * min(max(change, -_LARGEST_CHANGE), _LARGEST_CHANGE))
    s.stray = min(max(s.stray, r.least_stray), r.most_stray)
