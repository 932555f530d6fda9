"""Find readings that are no measurements: zeros, repeats, saturation, and values that no hand makes.

A sensor that stops, a link that stutters or a chip at the end of its range goes on sending numbers. Such rows
become NaN, as if they had not come, so that whatever uses the log grows less certain across them.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.clocks import usual_step
from xsens.logs.samples import VECTORS, ImuLog, finite_rows, median, median_norm, row_norms


class _Limits(NamedTuple):
    """Largest value of an axis, change that ends a repeat, height of a spike, and least end of the range."""

    largest: float
    change: float
    spike: float
    least_end: float = np.inf


_ORIENTATION = "own orientation"
LIMITS = {
    VECTORS[0]: _Limits(2000.0, 0.3, 100.0, 12.0),
    VECTORS[1]: _Limits(60.0, 0.03, 10.0, 0.05),
    VECTORS[2]: _Limits(100.0, 0.03, 1.0),
    _ORIENTATION: _Limits(np.inf, 0.05, np.inf),
}
"""Accelerometers end at 200 g, gyroscopes at 35 rad/s; a hand's knock lasts longer than a sample. A resting
sensor's readings change by less than the second, its orientation by less than two degrees. The field's limits
are in its median norm: a magnet at 1 cm makes six of it, over many samples. A range ends beyond gravity, and
beyond a resting gyroscope's bias."""

_ABSURD = 1e6
"""Larger numbers are damage in any unit."""

_SLOW_RAD_S = 0.05
"""Rate that may be repeated at rest: the bias of a gyroscope, and a coarse one's last digits."""

_DROP_RAD_S = 0.3
"""Change by which a gyroscope that comes to rest is told from one that is stuck in slow movement."""

_STEADY_M_S2 = 1.0
"""Spread of the readings of a resting accelerometer; gravity turned by six degrees changes them as much."""

_TURNING_RAD_S = 0.2
"""Mean rate of a sensor that turns: eleven degrees per second, beyond any bias."""

_FEW = 0.05
"""Share of readings that may be errors; more are in another unit."""

_TURNS_APART = 5.0
"""Of rows in turn of several sensors, how much farther neighbours are apart than rows of one sensor."""

_NOISY = 10.0
"""Last digits: readings that change by more are not repeated by chance. Usual changes: more is a jump.
Runs that chance makes: longer ones are none, where readings change by many last digits."""

_STUCK = 5
"""Samples in which an axis may stand still by chance, where its noise is a few of its last digits."""

_BELOW = 16.0
"""How many times its bend from row to row a reading is below the end of its range, as many rows before and
after those in which it stays within one: twice a parabola's eight. 36 simulated hands have none."""

_END_TO_END = 1.5
"""Of an axis's largest reading, the change that only a number that wraps round makes, of two at most."""

_ENOUGH = 50
_MOST_SENSORS = 8
_LOOKED_AT = 1000
"""Rows on either side of the log's middle that tell whether sensors take turns."""


def without_faults(log: ImuLog) -> ImuLog:
    """The log with all that is no measurement missing, counted in its notes.

    Raises
    ------
    InvalidInputError
        If its rows are of several sensors in turn.
    """
    readings = {name: getattr(log, name) for name in VECTORS} | {_ORIENTATION: log.own_direction}
    readings = {name: np.asfortranarray(rows) for name, rows in readings.items() if rows is not None}
    _require_one_sensor(readings)
    changes: dict[str, Any] = {}
    notes: list[str] = []
    nothing = np.full((len(log), 3), np.nan)
    force, rate = (readings.get(name, nothing) for name in VECTORS[:2])
    for name, rows in readings.items():
        bad = _bad(name, rows, force, rate)
        if counts := ", ".join(f"{mask.sum()} {why}" for why, mask in bad.items() if mask.any()):
            notes.append(f"{name.split('_')[0]}: {counts}: taken as missing")
        wrong = np.logical_or.reduce(list(bad.values()))
        if name == _ORIENTATION:
            changes["oriented"] = log.oriented & ~wrong
        else:
            rows = np.where(wrong[:, None], np.nan, rows)
            changes[name] = rows if finite_rows(rows).any() else None
    return replace(log, **changes, notes=(*log.notes, *notes))


def _digit(steps: FloatArray) -> float:
    """Smallest change from row to row, of any axis: the last digit of a sensor."""
    size = np.abs(steps)
    return float(np.min(size, where=size > 0.0, initial=np.inf))


def _bad(name: str, rows: FloatArray, force: FloatArray, rate: FloatArray) -> dict[str, BoolArray]:
    """Rows that are no measurement of one sensor, by reason."""
    limits, size = LIMITS[name], row_norms(rows)
    zero, unit = size < 1e-12, 1.0
    if name == VECTORS[1]:  # at rest zero is a reading
        zero &= ~(row_norms(force) > 0.0)
    valid = ~(np.isnan(size) | zero)
    if name == VECTORS[2] and valid.any():
        unit = median(size[valid])
    beyond = size > limits.largest * unit
    if beyond.sum() > _FEW * (size >= 0.0).sum():  # another unit, which whoever uses the log refuses
        beyond = size >= _ABSURD
    valid &= ~beyond
    repeats = np.zeros_like(valid)
    if valid.any():
        repeats[valid] = _repeats(name, limits.change * unit, valid, rows, force, rate)
    valid &= ~repeats
    rows = np.where(valid[:, None], rows, np.nan)
    return {
        "readings of zero": zero,
        "out of range": beyond,
        "repeated": repeats,
        "with an axis that stands still": stuck_axes(rows, _SLOW_RAD_S if name == VECTORS[1] else 0.0),
        "at the end of the range": np.any([_cut_off(axis, limits.least_end) for axis in rows.T], axis=0),
        "single spikes": _spikes(rows, limits.spike * unit),
        "beyond a jump from end to end of the range": _wrapped(rows[:, : 3 * (name == VECTORS[1])]),
    }


def _repeats(
    name: str, change: float, valid: BoolArray, rows: FloatArray, force: FloatArray, rate: FloatArray
) -> Any:
    """Valid rows that repeat the one before, longer than two samples of the sensor's rate, and then change.

    One in ten of a sensor's samples may last longer: its rate is another than that of the log.
    Where readings before and after change by many of their last digits, none is repeated by chance.
    """
    rows = rows.T.compress(valid, axis=1).T
    start = np.flatnonzero(np.append(True, (rows[1:] != rows[:-1]).any(axis=1)))
    length = np.diff(np.append(start, len(rows)))
    if length.max() <= 2:
        return False
    force, rate = force[valid], rate[valid]
    middle, high = np.percentile(length, [50, 90]) if len(length) > 1 else (1, 1)
    usual = int(min(3.0 * middle, high))
    steps = np.diff(rows, axis=0)
    step = np.pad(row_norms(steps), 1, constant_values=np.nan)
    before, after = step[start], step[start + length]
    moves = (np.minimum(before, after) > _NOISY * _digit(steps)) | (after > change)
    moves |= np.isnan(after) & (start > 0)
    if name == VECTORS[1]:  # a resting one may read its bias, or zero
        spread = np.fmax.reduceat(force, start) - np.fmin.reduceat(force, start)
        still = ~(spread > _STEADY_M_S2).any(axis=1)
        drops = np.isnan(before) | np.isnan(after) | (before > _DROP_RAD_S)
        bias = still & drops & (row_norms(rows[start]) < _SLOW_RAD_S)
        bad = (moves & ~bias) | (np.isnan(after) & ~still)
    else:  # what is repeated to the log's end was left while the sensor turned
        turn = np.add.reduceat(np.nan_to_num(row_norms(rate)), start)
        bad = moves & (~np.isnan(after) | (turn > _TURNING_RAD_S * length))
    bad &= length > max(2, 2 * usual)
    # What readings jump to again and again is none, but a number that stands for none.
    _, code, count = np.unique(rows[start[bad]], axis=0, return_inverse=True, return_counts=True)
    valid = np.full(len(start), usual)
    valid[bad] *= (count[code] == 1) | ~(before[bad] > _NOISY * usual_step(step))
    place = np.arange(len(rows)) - np.repeat(start, length)
    return np.repeat(bad, length) & (place >= np.repeat(valid, length))


def stuck_axes(rows: FloatArray, least: float = 0.0) -> BoolArray:
    """Rows in which an axis repeats a value, at least so large, while others go on: saturated, or dead.

    At the end of its range slopes before and after are steep; a dead axis repeats a value for long.
    """
    bad = np.zeros(len(rows), dtype=bool)
    same = rows[1:] == rows[:-1]
    repeats = same.all(axis=1)
    alone = same & ~repeats[:, None]
    longest = _STUCK * len(rows) / (len(rows) - repeats.sum())
    for k in np.flatnonzero(alone.any(axis=0)).tolist():
        axis = rows[:, k].astype(float)
        first = np.flatnonzero(np.append(True, ~same[:, k]))
        length = np.diff(np.append(first, len(rows)))
        end, value = first + length, axis[first]
        steps = np.abs(np.pad(np.diff(axis), 2, constant_values=np.nan))
        usual = usual_step(steps, np.inf)
        at_end = (value == np.fmax.reduce(axis)) | (value == np.fmin.reduce(axis))
        steep = np.fmin(steps[first], steps[end + 2]) > 3.0 * _digit(steps)
        stuck = at_end & steep & (value != 0.0) & (np.abs(value) >= least)
        # Noise of many last digits repeats nothing, unless a gyroscope's small readings are cut to zero.
        if usual > _NOISY * _digit(steps) and (not least or np.nanmin(np.abs(axis[axis != 0.0])) < usual):
            stuck |= length > _NOISY * longest
        stuck &= np.add.reduceat(np.append(alone[:, k], 0), first) > 1
        bad |= np.repeat(stuck, length)
    return bad


def _cut_off(axis: FloatArray, least: float) -> Any:
    """Rows at the end of an axis's range, if it stays there as no smooth peak does, whatever noise is added.

    A peak that stays within a band of its height is a parabola, and eight bands lower as many rows away.
    Noise of the usual bend from row to row keeps no reading within such a band for long, unless it is lost
    in the last digit.
    """
    steps = np.diff(axis)
    size, band = np.abs(axis), median(np.abs(np.diff(steps)))
    end = np.fmax.reduce(size)
    if not (end >= least and band > _digit(steps)):
        return np.zeros(size.size, dtype=bool)
    inside = size >= end - band
    first, after = np.flatnonzero(np.diff(np.pad(inside, 1))).reshape(-1, 2).T
    count = after - first
    around = size.take([first - count, after + count - 1], mode="clip").max(axis=0)
    return inside & ((count > _STUCK) & (around < end - _BELOW * band)).any()


def _spikes(rows: FloatArray, height: float) -> BoolArray:
    """Single rows far from both neighbours, which are near each other."""
    spikes = np.pad(row_norms(np.diff(rows, axis=0)) > height, 1)
    spikes = spikes[1:] | spikes[:-1]  # where one may be
    index = np.flatnonzero(spikes)
    before, after = rows[abs(index - 1)], rows[len(rows) - 1 - abs(len(rows) - 2 - index)]
    away = row_norms(rows[index] - 0.5 * (before + after))
    spikes[index] = (away > height) & (row_norms(after - before) < 0.2 * away)
    return spikes


def _wrapped(rows: FloatArray) -> BoolArray:
    """Rows between jumps of an axis from one end of its range to the other, and back: the rarer ones.

    Beside the jumps of numbers that wrap round it changes little, unlike in a knock.
    """
    bad = np.zeros(len(rows), dtype=bool)
    for axis in rows.T:
        steps = np.diff(axis, prepend=axis[:1])
        size = np.abs(steps)
        jump = size > _END_TO_END * np.fmax.reduce(np.abs(axis), initial=0.0)
        if not jump.any():
            continue
        jump &= size > _NOISY * usual_step(size, np.inf)
        rough = np.pad(~jump & (size > 0.1 * np.fmax.reduce(size)), 1)
        jump &= ~(rough[:-2] | rough[2:])
        turns = np.cumsum(np.where(jump, np.sign(steps), 0.0)).astype(np.int64)
        bad |= turns != np.bincount(turns - turns.min()).argmax() + turns.min()
    return bad


def _require_one_sensor(readings: dict[str, FloatArray]) -> None:
    """Raise if every second, third... row is alike and neighbours are not: sensors that take turns."""
    for name, rows in readings.items():
        if name == VECTORS[1] or len(rows) < _ENOUGH:  # a gyroscope's noise is as large as its rate
            continue
        middle = len(rows) // 2
        rows = rows[max(middle - _LOOKED_AT, 0) : middle + _LOOKED_AT]
        rows = np.where(row_norms(rows)[:, None] > 0.0, rows, np.nan)
        difference = [median_norm(rows[lag:] - rows[:-lag]) for lag in range(1, _MOST_SENSORS + 1)]
        least = 0.02 * median_norm(rows)
        for sensors in range(2, _MOST_SENSORS + 1):
            if np.min(difference[: sensors - 1]) > _TURNS_APART * difference[sensors - 1] + least:
                raise InvalidInputError(
                    f"expected the rows of one sensor, got those of {sensors} in turn: neighbouring readings "
                    f"differ, and every {sensors}. is alike: split the table"
                )
