"""The angle from level axes, carried by the gyroscope, to magnetic north: a Kalman filter of the field.

`xsens.fusion.heading` says what is done and why.
"""

import math
from typing import Any

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.kernels.copying import copy_into
from speckle3d.kernels.orientation.rotations import (
    add_product,
    compiled,
    for_kernels,
    inverse,
    norm,
    squared_norm,
    store,
    subtract_product,
    times_transpose,
)

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
        ("bias", "f8", 3),  # that the level axes are turned without, at its end, rad/s
        ("field", "f8", 3),  # mean in the level axes
        ("field_rate", "f8", 3),  # its derivative by the magnetometer's lag, 1/s
        ("level", "f8", (3, 3)),  # mean level axes from the sensor's
        ("tilt_rad2", "f8"),  # variance of the level axes' tilt
    ],
    align=True,
)
"""A quarter of a second of the sensor's movement."""

MODEL = np.dtype(
    [
        ("iron", "f8"),  # deviations: of iron on the sensor at the start
        ("iron_put_on", "f8"),  # of iron put on later, zero if none ever is
        ("first_place", "f8"),  # of what the first place adds
        ("beside_iron", "?"),  # whether that place is left at a reading that shows another
        ("first_stray", "f8"),  # of the first reading's stray, a fraction of the stray's
    ],
    align=True,
)
"""What a filter takes for granted."""

FILTER = np.dtype(
    [
        ("x", "f8", SIZE),
        ("p", "f8", (SIZE, SIZE)),
        ("norm", "f8"),  # of the first reading, the unit of all
        ("bias", "f8", 3),  # that of the last bin
        ("doubt", "f8"),
        ("stray", "f8"),  # deviation now
        ("begun", "?"),  # in this stretch
        ("ran", "?"),  # ever
        ("rested", "?"),  # in the last bin
        ("beside", "?"),  # iron, since the start
        ("changing_s", "f8"),  # how long iron is still being put on, or left
    ],
    align=True,
)

HEADING = np.dtype([(name, "f8") for name in ("turn_rad", "variance", "evidence", "doubt", "trust", "stray")])
"""Angle from the level axes to north at the end of a bin, and its variance; logarithm of the density of its
reading in movement; of the odds that the first place was beside iron; the reading's weight, 0 to 1; the
stray."""

_LAG_S = 0.015
"""Standard deviation of the magnetometer's delay behind the gyroscope: a chip that averages readings and
sends them at a lower rate is 10 to 20 ms late."""

_NOISE_SQRT_S = 0.002
"""Noise of the magnetometer, as a fraction of the field's norm."""

_PLACE = 0.05
"""Standard deviation of what a place adds to the room's field, as a fraction of its norm, per component: 8
degrees of heading where the field dips by 68 degrees."""

_LEAST_STRAY, _MOST_STRAY = 0.005, 0.3

_STRAY_S, _ADAPTS_S = 2.0, 60.0
"""How long a stray persists, a hand's length at a hand's speed; how fast its variance is followed."""

_BIAS_S = 10.0
"""How long what is left of the gyroscope's bias persists."""

_WALK_SQRT_S = 0.0003
"""The room's random walk: 1 % in twenty minutes."""

_FREEDOM = 3.0
"""Of Student's distribution of the readings' errors."""

_OUTLIER = 25.0
"""Squared misfit that shows iron put on or off, or left: one in 10^5 with normal errors."""

_CHANGE_S = 3.0
"""How long putting iron on the sensor takes, or leaving iron beside it."""

_DOUBT_S, _BESIDE_S = 1.0, 3.0
"""Times of movement after which odds are less by e: of a field that is disbelieved to be the room's after
all, and of a sensor that began beside iron to be still there: iron's field is uneven over a hand's length."""

_INFORMATION = 1.5
"""Fisher's information on the logarithm of a variance that one vector gives."""

_LARGEST_SCORE, _LARGEST_CHANGE = 50.0, 0.5
"""Bounds of a reading's squared misfit, and of the change of that logarithm, in one bin."""


@compiled
def find_headings(
    bins: Any,
    models: Any,
    filters: Any,
    headings: Any,
    states: FloatArray,
    covariances: FloatArray,
    transitions: FloatArray,
    noises: FloatArray,
) -> None:
    """Run every model's filter over bins.

    Parameters
    ----------
    bins : structured ndarray, shape (n,), of `BIN`
    models : structured ndarray, shape (k,), of `MODEL`
    filters : structured ndarray, shape (k,), of `FILTER`
        Changed in place.
    headings : structured ndarray, shape (n, k), of `HEADING`
        Filled.
    states, covariances, transitions, noises : ndarray, shapes (k, n, SIZE) and (k, n, SIZE, SIZE), or k = 0
        Filled: after each bin, and from the one before to it.
    """
    f, q = np.eye(SIZE), np.zeros((SIZE, SIZE))
    for j in range(models.shape[0]):
        s, m = filters[j], models[j]
        for k in range(bins.shape[0]):
            b, out = bins[k], headings[k, j]
            out.trust, out.turn_rad, out.variance, out.evidence = 0.0, 0.0, math.pi**2, 0.0
            if not s.begun and b.seen:
                _begin(s, b, m)
            if s.begun:
                _predict(s, b, m, f, q)
                if b.seen:
                    _correct(s, b, m, f, q, out)
                out.turn_rad, out.variance = turn_to_north(s.x, s.p)
                if states.shape[0] > 0:
                    store(s.x, states[j, k])
                    copy_into(covariances[j, k], s.p)
                    copy_into(transitions[j, k], f)
                    copy_into(noises[j, k], q)
            out.stray, out.doubt = s.stray, s.doubt


@compiled
def turn_to_north(x: FloatArray, p: FloatArray) -> tuple[float, float]:
    """Angle about up from the level axes to north, by the room's field, and its variance."""
    across, along = x[ROOM], x[ROOM + 1]
    square = across * across + along * along
    if square == 0.0:
        return 0.0, math.pi**2
    variance = along * along * p[0, 0] + across * across * p[1, 1] - 2.0 * across * along * p[0, 1]
    return -math.atan2(along, across), min(max(variance / (square * square), 0.0), math.pi**2)


@for_kernels
def _begin(s: Any, b: Any, m: Any) -> None:
    """Begin with the bin's reading; after a pause with the iron and lag found so far."""
    if not s.ran:
        s.norm = norm(b.field)
        for i in range(3):
            s.p[IRON + i, IRON + i] = m.iron**2
        s.p[LAG, LAG] = _LAG_S**2
    for i in range(3):
        _forget(s, ROOM + i, 1.0)
        _forget(s, BIAS + i, math.sqrt(b.bias_variance))
        _forget(s, PLACE + i, _PLACE if s.ran else m.first_place)
        _forget(s, STRAY + i, m.first_stray * s.stray)
        s.x[ROOM + i] = b.field[i] / s.norm
        for j in range(3):
            s.x[ROOM + i] -= b.level[i, j] * s.x[IRON + j]
    store(b.bias, s.bias)
    s.changing_s, s.beside = 0.0, m.beside_iron and not s.ran
    s.begun, s.ran, s.rested = True, True, b.resting


@for_kernels
def _forget(s: Any, i: int, sd: float) -> None:
    """Set a state anew, to zero with that deviation."""
    s.x[i] = 0.0
    for j in range(SIZE):
        s.p[i, j] = s.p[j, i] = 0.0
    s.p[i, i] = sd * sd


@for_kernels
def _predict(s: Any, b: Any, m: Any, f: FloatArray, q: FloatArray) -> None:
    """Predict over a bin; fill its transition and noise."""
    span, across, along = b.span_s, s.x[ROOM], s.x[ROOM + 1]
    moving, moves_on = 0.0 if b.resting else 1.0, b.resting != s.rested
    keep_bias, keep_stray = math.exp(-span / _BIAS_S), math.exp(-moving * span / _STRAY_S)
    leaves = m.beside_iron and s.changing_s > 0.0  # iron, and at last for a place as any other
    place = m.first_place if leaves and s.changing_s > span else _PLACE
    moves_on = moves_on or leaves
    s.rested = b.resting
    for i in range(3):
        s.x[BIAS + i] -= b.bias[i] - s.bias[i]
        s.bias[i] = b.bias[i]
        turn = moving * span * keep_bias * b.level[2, i]
        f[ROOM, BIAS + i], f[ROOM + 1, BIAS + i] = -turn * along, turn * across
        f[BIAS + i, BIAS + i], f[STRAY + i, STRAY + i] = keep_bias, keep_stray
        f[PLACE + i, PLACE + i] = 1.0 if s.beside or not moves_on else 0.0
        q[ROOM + i, ROOM + i] = _WALK_SQRT_S**2 * span
        q[BIAS + i, BIAS + i] = (1.0 - keep_bias**2) * b.bias_variance
        q[IRON + i, IRON + i] = m.iron_put_on**2 if s.changing_s > 0.0 else 0.0
        q[PLACE + i, PLACE + i] = place**2 if moves_on else 0.0
        q[STRAY + i, STRAY + i] = (1.0 - keep_stray**2) * s.stray**2
    q[ROOM, ROOM] += b.slip_rad2 * along * along
    q[ROOM + 1, ROOM + 1] += b.slip_rad2 * across * across
    q[ROOM, ROOM + 1] = q[ROOM + 1, ROOM] = -b.slip_rad2 * across * along
    s.changing_s = max(s.changing_s - span, 0.0)
    x, p = np.zeros(SIZE), times_transpose(f, times_transpose(f, s.p))
    add_product(x, f, s.x)
    store(x, s.x)
    for i in range(SIZE):
        for j in range(SIZE):
            s.p[i, j] = p[i, j] + q[i, j]


@for_kernels
def _correct(s: Any, b: Any, m: Any, f: FloatArray, q: FloatArray, out: Any) -> None:
    """Correct by a reading, the less the less likely it is: its errors have Student's distribution.

    An outlier is left out: what disturbs it may last longer than a stray does.

    Of fields only that of the room is turned by errors of the heading: place and stray have random
    directions, and turned they are as likely; a linear filter would take their turns for knowledge of it.
    """
    for again in (False, True):
        off, cross, total = _innovation(s, b)
        weight, determinant = inverse(total, 0.0)
        misfit = squared_norm(off, weight)
        if not (again or b.resting):
            _adapt(s, b, off, misfit, weight)
        if again or misfit <= _OUTLIER or not _foresee_change(s, m, f, q, off, total):
            break
    v = _FREEDOM
    out.trust = min((v + 3.0) / (v + misfit), 1.0)
    if not b.resting:  # a sensor at rest repeats itself and proves nothing
        out.evidence = -0.5 * math.log(determinant) - 0.5 * (v + 3.0) * math.log(1.0 + misfit / v)
        s.doubt += b.span_s * ((1.0 - out.trust) / _DOUBT_S + (1.0 / _BESIDE_S if s.beside else 0.0))
    if misfit > _OUTLIER:
        out.trust = 0.0
        return
    if out.trust < 1.0:
        extra = (1.0 / out.trust - 1.0) * (total[0, 0] + total[1, 1] + total[2, 2]) / 3.0
        weight, _ = inverse(total, extra)
    gain = times_transpose(cross, weight)
    add_product(s.x, gain, off)
    subtract_product(s.p, gain, cross)
    for i in range(SIZE):
        for j in range(i):
            s.p[i, j] = s.p[j, i] = 0.5 * (s.p[i, j] + s.p[j, i])


@for_kernels
def _foresee_change(s: Any, m: Any, f: FloatArray, q: FloatArray, off: FloatArray, total: FloatArray) -> bool:
    """Whether an outlier is iron put on the sensor, or iron beside it left behind; if so, foresee it."""
    if m.iron_put_on > 0.0 and s.changing_s <= 0.0:
        s.changing_s = _CHANGE_S
        for i in range(IRON, IRON + 3):
            s.p[i, i] += m.iron_put_on**2
            q[i, i] += m.iron_put_on**2
        return True
    if not s.beside or squared_norm(off, inverse(total, _PLACE**2)[0]) <= _OUTLIER:
        return False
    s.beside, s.changing_s = False, _CHANGE_S
    for i in range(PLACE, PLACE + 3):
        _forget(s, i, m.first_place)
        f[i, i], q[i, i] = 0.0, m.first_place**2
    return True


@for_kernels
def _innovation(s: Any, b: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The reading less what is expected, its covariance with the state, and its own.

    The last holds its noise, and what the level axes' tilt makes of the field.
    """
    h, total, off = np.zeros((3, SIZE)), np.zeros((3, 3)), np.empty(3)
    for i in range(3):
        off[i] = b.field[i] / s.norm
        h[i, ROOM + i] = h[i, PLACE + i] = h[i, STRAY + i] = 1.0
        h[i, LAG] = b.field_rate[i] / s.norm
        for j in range(3):
            h[i, IRON + j] = b.level[i, j]
    cross = times_transpose(s.p, h)
    across, up = s.x[ROOM] ** 2 + s.x[ROOM + 1] ** 2, s.x[ROOM + 2] ** 2
    for i in range(3):
        for k in range(SIZE):
            off[i] -= h[i, k] * s.x[k]
            for j in range(3):
                total[i, j] += h[i, k] * cross[k, j]
        total[i, i] += _NOISE_SQRT_S**2 / b.span_s + b.tilt_rad2 * (up if i < 2 else across)
    return off, cross, total


@for_kernels
def _adapt(s: Any, b: Any, off: FloatArray, misfit: float, weight: FloatArray) -> None:
    """Follow the stray's variance by the slope of the reading's likelihood: the room may become another."""
    score_vector = np.zeros(3)
    add_product(score_vector, weight, off)
    share = min(1.0, _LARGEST_SCORE / misfit)
    score = 0.0
    for i in range(3):
        score += 0.5 * s.p[STRAY + i, STRAY + i] * (share * score_vector[i] ** 2 - weight[i, i])
    change = score * b.span_s / (_INFORMATION * _ADAPTS_S)
    s.stray *= math.exp(0.5 * min(max(change, -_LARGEST_CHANGE), _LARGEST_CHANGE))
    s.stray = min(max(s.stray, _LEAST_STRAY), _MOST_STRAY)
