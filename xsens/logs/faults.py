"""Find readings that are no measurements: zeros, repeats, saturation, and values that no hand makes.

A sensor that stops, a link that stutters or a chip at the end of its range goes on sending numbers. Such rows
become NaN, as if they had not come, so that whatever uses the log grows less certain across them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.samples import VECTORS, ImuLog


class _Limits(NamedTuple):
    """Largest value of an axis, change that ends a repeat, and height of a spike, in a sensor's unit."""

    largest: float
    change: float
    spike: float


_LIMITS = {
    VECTORS[0]: _Limits(2000.0, 0.3, 100.0),
    VECTORS[1]: _Limits(60.0, 0.03, 10.0),
    VECTORS[2]: _Limits(100.0, 0.03, np.inf),
}
"""Accelerometers end at 200 g, gyroscopes at 35 rad/s; a hand's knock lasts longer than a sample. A resting
sensor's readings change by less than the second. The field's limits are in its median norm: a magnet at 1 cm
makes six of it."""

_ABSURD = 1e6
"""Larger numbers are damage in any unit."""

_SLOW_RAD_S = 0.05
"""Rate that may be repeated at rest: the bias of a gyroscope, and a coarse one's last digits."""

_DROP_RAD_S = 0.3
"""Change by which a gyroscope that reads zero amid movement is told from one at the turning point."""

_STEADY_M_S2 = 1.0
"""Spread of the readings of a resting accelerometer; gravity turned by six degrees changes them as much."""

_TURNING_RAD_S = 0.2
"""Mean rate of a sensor that turns: eleven degrees per second, beyond any bias."""

_FEW = 0.05
"""Share of readings that may be errors; more are in another unit."""

_STUCK_RAD = 0.035
"""Turn after a repeated orientation that shows that it was not at rest: two degrees."""

_OTHER = 5.0
"""Of rows in turn of several sensors, how much farther neighbours are apart than rows of one sensor."""

_ENOUGH = 50
_MOST_SENSORS = 8
_LOOKED_AT = 1000
"""Rows on either side of the log's middle that tell whether sensors take turns."""


def measured(log: ImuLog) -> ImuLog:
    """The log with all that is no measurement missing, counted in its notes.

    Raises
    ------
    InvalidInputError
        If its rows are of several sensors in turn.
    """
    log = _without_damage(log)
    _require_one_sensor(log)
    readings: dict[str, FloatArray | None] = {name: getattr(log, name) for name in VECTORS}
    dead = np.zeros(len(log), dtype=bool)
    notes: list[str] = []
    for name in VECTORS:
        rows = readings[name]
        if rows is None or not _every(np.isfinite(rows)).any():
            readings[name] = None
            continue
        bad = _bad(name, rows, dead, log)
        if name == VECTORS[0]:
            dead = bad["zero"] | ~_every(np.isfinite(rows))
        counts = {why: int(mask.sum()) for why, mask in bad.items() if mask.any()}
        if not counts:
            continue
        wrong = np.logical_or.reduce(list(bad.values()))
        told = ", ".join(f"{count} {_WORDS[why]}" for why, count in counts.items())
        notes.append(f"{name.split('_')[0]}: {told}: taken as missing")
        left = ~wrong & np.isfinite(rows).all(axis=1)
        readings[name] = np.where(wrong[:, None], np.nan, rows) if left.any() else None
    changed: dict[str, Any] = {k: v for k, v in readings.items() if v is not getattr(log, k)}
    stuck = _stuck(log)
    if stuck.any():
        notes.append(f"own orientation: {int(stuck.sum())} repeated: taken as missing")
        changed["oriented"] = log.oriented & ~stuck
    return replace(log, **changed, notes=(*log.notes, *notes)) if changed else log


_WORDS = {
    "zero": "readings of zero",
    "range": "out of range",
    "repeat": "repeated",
    "end": "at the end of the range",
    "spike": "single spikes",
}


def _without_damage(log: ImuLog) -> ImuLog:
    """The log without numbers that are damage in any unit, counted in its notes."""
    changed: dict[str, Any] = {}
    notes = []
    for name in VECTORS:
        rows = getattr(log, name)
        if rows is not None and (np.abs(rows) >= _ABSURD).any():
            wild = (np.abs(rows) >= _ABSURD).any(axis=1)
            changed[name] = np.where(wild[:, None], np.nan, rows)
            notes.append(f"{name.split('_')[0]}: {int(wild.sum())} out of range: taken as missing")
    return replace(log, **changed, notes=(*log.notes, *notes)) if changed else log


def _bad(name: str, rows: FloatArray, dead: BoolArray, log: ImuLog) -> dict[str, BoolArray]:
    """Rows that are no measurement of one sensor, by reason; `dead` where the accelerometer reads nothing."""
    limits, finite = _LIMITS[name], _every(np.isfinite(rows))
    rows = rows if finite.all() else np.where(finite[:, None], rows, np.nan)
    size = np.fmax.reduce([np.abs(np.where(finite, axis, 0.0)) for axis in rows.T])
    zero, unit = finite & (size == 0.0), 1.0
    if name == VECTORS[2]:
        zero |= finite & (size < 1e-12)
        some = finite & ~zero
        unit = float(np.median(np.linalg.norm(rows[some], axis=1))) if some.any() else 1.0
    beyond = finite & (size > limits.largest * unit)
    if beyond.sum() > _FEW * finite.sum():  # another unit, which whoever uses the log refuses
        beyond[:] = False
    rows = np.where(beyond[:, None], np.nan, rows) if beyond.any() else rows
    start, length = _runs(rows)
    usual, (before, after) = int(np.median(length)), _jumps(rows, start, length)
    repeat = (length > max(2, 2 * usual)) & ((after > limits.change * unit) | (np.isnan(after) & (start > 0)))
    if name == VECTORS[1]:
        slow = np.linalg.norm(rows[start], axis=1) < _SLOW_RAD_S
        begun = np.isnan(before) | np.isnan(after) | (before > _DROP_RAD_S)
        still = slow & begun & _steady(log.accelerometer_m_s2, start, length)
        repeat &= ~still
        dropped = (np.fmax(before, after) > _DROP_RAD_S) & ~still
        zero &= dead | _spread(start, length, repeat | dropped, 0, len(rows))
    else:  # what is repeated to the log's end was left while the sensor turned
        repeat &= ~np.isnan(after) | _turning(log.gyroscope_rad_s, start, length)
    repeated = _spread(start, length, repeat, usual, len(rows)) & finite & ~zero
    clipped = _clipped(rows) & ~repeated & ~zero
    spike = _spikes(rows, limits.spike * unit) & ~beyond & ~zero
    return {"zero": zero, "range": beyond, "repeat": repeated, "end": clipped, "spike": spike}


def _steady(force: FloatArray | None, start: IntArray, length: IntArray) -> BoolArray:
    """Runs of one sensor in which the accelerometer shows no turning."""
    if force is None:
        return np.ones(len(start), dtype=bool)
    spread = [np.fmax.reduceat(axis, start) - np.fmin.reduceat(axis, start) for axis in force.T]
    return np.asarray(~(np.fmax.reduce(spread) > _STEADY_M_S2))


def _turning(rate: FloatArray | None, start: IntArray, length: IntArray) -> BoolArray:
    """Runs of one sensor in which the gyroscope turns."""
    if rate is None:
        return np.zeros(len(start), dtype=bool)
    total = np.append(0.0, np.cumsum(np.nan_to_num(np.linalg.norm(rate, axis=1))))
    return np.asarray((total[start + length] - total[start]) / length > _TURNING_RAD_S)


def _every(marks: BoolArray) -> BoolArray:
    """Rows of which each number is marked; many times faster than a reduction over a few columns."""
    return np.asarray(np.logical_and.reduce(list(marks.T)))


def _runs(rows: FloatArray) -> tuple[IntArray, IntArray]:
    """First rows and lengths of runs of one value."""
    same = _every(rows[1:] == rows[:-1])
    start = np.flatnonzero(np.append(True, ~same))
    return start, np.diff(np.append(start, len(rows)))


def _jumps(rows: FloatArray, start: IntArray, length: IntArray) -> tuple[FloatArray, FloatArray]:
    """Change into each run and out of it; NaN where the log begins or ends."""
    before = np.linalg.norm(rows[start] - rows[np.maximum(start - 1, 0)], axis=1)
    end = start + length
    after = np.linalg.norm(rows[start] - rows[np.minimum(end, len(rows) - 1)], axis=1)
    return np.where(start > 0, before, np.nan), np.where(end < len(rows), after, np.nan)


def _spread(start: IntArray, length: IntArray, which: BoolArray, skip: int, size: int) -> BoolArray:
    """Mark the rows of some runs but their first `skip`."""
    mask = np.zeros(size + 1)
    np.add.at(mask, start[which] + np.minimum(skip, length[which]), 1.0)
    np.add.at(mask, (start + length)[which], -1.0)
    return np.asarray(np.cumsum(mask)[:size] > 0.5)


def _clipped(rows: FloatArray) -> BoolArray:
    """Rows in which an axis stays at its highest or lowest value, from one steep slope to another."""
    bad = np.zeros(len(rows), dtype=bool)
    changes = np.append(0, np.cumsum(~_every(rows[1:] == rows[:-1])))
    for axis in rows.T:
        if np.isnan(axis).all():
            continue
        if max((axis == np.nanmax(axis)).sum(), (axis == np.nanmin(axis)).sum()) < 3:
            continue
        steps = np.abs(np.diff(axis))
        digit = np.min(steps[steps > 0.0], initial=np.inf)
        start, length = _runs(axis[:, None])
        readings = changes[start + length - 1] - changes[start] + 1
        padded = np.pad(axis, 2, mode="edge")
        into = np.abs(padded[start + 1] - padded[start])
        out = np.abs(padded[np.minimum(start + length + 3, len(padded) - 1)] - padded[start + length + 2])
        top = (axis[start] == np.nanmax(axis)) | (axis[start] == np.nanmin(axis))
        flat = top & (readings > 2) & (np.minimum(into, out) > 3.0 * digit) & (axis[start] != 0.0)
        bad |= _spread(start, length, flat, 0, len(rows))
    return bad


def _spikes(rows: FloatArray, height: float) -> BoolArray:
    """Single rows far from both neighbours, which are near each other."""
    if len(rows) < 3 or not np.isfinite(height):
        return np.zeros(len(rows), dtype=bool)
    padded = np.concatenate([rows[1:2], rows, rows[-2:-1]])
    away = np.linalg.norm(rows - 0.5 * (padded[:-2] + padded[2:]), axis=1)
    return np.asarray((away > height) & (np.linalg.norm(padded[2:] - padded[:-2], axis=1) < 0.2 * away))


def _stuck(log: ImuLog) -> BoolArray:
    """Own orientations that are repeated although the sensor went on turning."""
    stuck = np.zeros(len(log), dtype=bool)
    if log.world_from_sensor is None or log.oriented.sum() < 2:
        return stuck
    at = np.flatnonzero(log.oriented)
    rows = log.world_from_sensor[at].as_quat()
    start, length = _runs(rows)
    end = np.minimum(start + length, len(rows) - 1)
    turn = (Rotation.from_quat(rows[start]).inv() * Rotation.from_quat(rows[end])).magnitude()
    usual = int(np.median(length))
    goes_on = start + length == len(rows)
    rate = log.gyroscope_rad_s
    behind = (turn > _STUCK_RAD) | (goes_on & _turning(None if rate is None else rate[at], start, length))
    long = (length > max(2, 2 * usual)) & behind
    stuck[at] = _spread(start, length, long, usual, len(rows))
    return stuck


def _require_one_sensor(log: ImuLog) -> None:
    """Raise if every second, third... row is alike and neighbours are not: sensors that take turns."""
    quaternions = None
    if log.world_from_sensor is not None and log.oriented.all():
        quaternions = np.abs(log.world_from_sensor.as_quat())
    for rows in (log.accelerometer_m_s2, log.magnetometer_au, quaternions):
        if rows is None or len(rows) < _ENOUGH:
            continue
        middle = len(rows) // 2
        rows = rows[max(middle - _LOOKED_AT, 0) : middle + _LOOKED_AT]
        rows = np.where((rows != 0.0).any(axis=1)[:, None], rows, np.nan)
        apart = [_median_norm(rows[lag:] - rows[:-lag]) for lag in range(1, _MOST_SENSORS + 1)]
        for sensors in range(2, _MOST_SENSORS + 1):
            if np.min(apart[: sensors - 1]) > _OTHER * apart[sensors - 1] + 0.02 * _median_norm(rows):
                raise InvalidInputError(
                    f"expected the rows of one sensor, got those of {sensors} in turn: neighbouring readings "
                    f"differ, and every {sensors}. is alike: split the table"
                )


def _median_norm(rows: FloatArray) -> float:
    """Median length of the rows that have one; NaN if none has."""
    norms = np.linalg.norm(rows, axis=1)
    norms = norms[np.isfinite(norms)]
    return float(np.median(norms)) if norms.size else float("nan")


_RUNS = 9
"""Runs of one value whose median length is the usual one while samples arrive."""


class LiveFaults:
    """Readings that are no measurements, as they arrive: zeros, repeats in movement, values out of range."""

    def __init__(self) -> None:
        self._last = np.full((3, 3), np.nan)
        self._run = np.zeros(3, dtype=int)
        self._lengths: tuple[deque[int], ...] = tuple(deque(maxlen=_RUNS) for _ in VECTORS)

    def measured(self, *readings: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rate, force and field of a sample, each NaN if it is no measurement."""
        rate, force, field = readings
        dead = np.isnan(force).any() or not force.any()
        moves = float(np.linalg.norm(rate)) > _SLOW_RAD_S
        bad = [bool(dead and not rate.any()), bool(dead), not field.any()]
        for i, (reading, limits) in enumerate(zip(readings, _LIVE, strict=True)):
            if (reading == self._last[i]).all():
                self._run[i] += 1
            else:
                if self._run[i]:
                    self._lengths[i].append(int(self._run[i]))
                self._last[i], self._run[i] = reading, 1
            known = len(self._lengths[i]) == _RUNS
            bad[i] |= moves and known and self._run[i] > max(2, 2 * int(np.median(self._lengths[i])))
            bad[i] |= bool((np.abs(reading) > limits).any())
        rate, force, field = (
            np.full(3, np.nan) if wrong else row for wrong, row in zip(bad, readings, strict=True)
        )
        return rate, force, field


_LIVE = (_LIMITS[VECTORS[1]].largest, _LIMITS[VECTORS[0]].largest, 1e12)
