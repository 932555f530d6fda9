"""Rebuild the times of samples and find missing ones from the sensor's counter and clock.

Counter and clock wrap round; both are unwrapped. A sensor that was unplugged starts
both anew: the length of that pause is known only from the computer's clock, if the recording holds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.samples import Gap

UNKNOWN_PAUSE_S = 1.0
"""Assumed pause before a new start of unknown length; longer than interpolation bridges."""

_RATES_HZ = (1e-3, 1e5)
"""Sampling rates that a sensor may have: they end at 2 kHz."""

SHORTEST_S = 4e-4
"""No sensor's samples are closer: they end at 2 kHz."""

COUNTS, TICKS, TICK_S = 1 << 16, 1 << 32, 1e-4
"""Where the sensors' counter and clock wrap round, and the clock's unit."""

_RARE = 0.01
_LONGER, _MUCH_LONGER = 1.6, 10.0
"""A clock step of more periods is a gap; the latter if the clock is irregular."""

_SHORTER = 0.6
"""A loss makes no step shorter than the period, rounding to 10 ms at 64 Hz none below this share of it."""

_MOST_PERIODS = 2.0**53

LATE = 64
"""A sample that comes at most so many samples late was overtaken, whatever follows."""

_OVERTAKINGS = 100
"""Steps far back that are looked at, each in a time that grows with the log; more are new starts."""

_AGREES = 1.1
"""Ratio up to which a stated rate and that of the times agree: clocks of sensors are good to 1 %."""


@dataclass(frozen=True)
class Stamps:
    """Time stamps of `m` samples as sent.

    Attributes
    ----------
    counter : ndarray of int, shape (m,), optional
        As `unwrap` has it.
    time_s : ndarray, shape (m,), optional
        By the sensor's clock, likewise.
    period_s : float
        Sampling period as configured or stated; NaN if not known.
    others : ndarray of int, shape (m,), optional
        Number of messages before each sample that the sensor counted, but that were no samples.
    starts : ndarray of bool, shape (m,), optional
        True for samples before which the sensor was started anew.
    computer_s : ndarray, shape (m,), optional
        The computer's clock at those starts; NaN elsewhere.
    """

    counter: IntArray | None = None
    time_s: FloatArray | None = None
    period_s: float = float("nan")
    extras: IntArray | None = None
    starts: BoolArray | None = None
    computer_s: FloatArray | None = None

    def __getitem__(self, index: Any) -> Stamps:
        arrays: dict[str, Any] = {k: v[index] for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **arrays)


@dataclass(frozen=True)
class Timeline:
    """Times of the samples that are kept (of those sent twice, one), with their counter made to rise.

    `rows` are the indices of those samples in order of time; all of them as a slice.
    """

    rows: IntArray | slice
    time_s: FloatArray
    counter: IntArray | None = None
    gaps: tuple[Gap, ...] = ()
    notes: tuple[str, ...] = ()


def require_rate(rate_hz: float, name: str) -> None:
    """Raise `InvalidInputError` if no sensor has such a sampling rate."""
    low, high = _RATES_HZ
    if not low <= rate_hz <= high:
        raise InvalidInputError(f"{name}: expected {low:g} to {high:g} Hz, got {rate_hz:g}")


def unwrap(values: Any, span: int) -> Any:
    """Unwrap a counter or clock that wraps round at a span; one that never falls stays as it is."""
    steps = np.diff(values)
    if (steps >= 0).all():
        return values
    steps = (steps + span // 2) % span - span // 2
    return values[0] + _running_sums(steps)


def spread(stamps: Stamps, readings: Sequence[FloatArray | None]) -> tuple[Stamps, tuple[str, ...]]:
    """Spread samples that came together, stamped on arrival, over the time since those before; a note on it.

    Rows of readings that repeat the one before are the same sample, sent twice.
    """
    if stamps.time_s is None or stamps.time_s.size < 2:
        return stamps, ()
    steps = np.diff(stamps.time_s)
    together = (steps >= 0.0) & (steps < SHORTEST_S)
    differ = np.any([(rows[1:] != rows[:-1]).any(axis=1) for rows in readings if rows is not None], axis=0)
    if together.all() or 2 * (together & differ).sum() <= steps.size:
        return stamps, ()
    first = np.flatnonzero(np.append(True, ~together))
    counts, arrival_s = np.diff(np.append(first, steps.size + 1)), stamps.time_s[first]
    spans = np.diff(arrival_s) / counts[1:]
    usual = np.median(spans)
    period_s = np.append(usual, np.minimum(spans, _LONGER * usual))
    before = np.repeat(first + counts - 1, counts) - np.arange(steps.size + 1)
    time_s = np.repeat(arrival_s, counts) - before * np.repeat(period_s, counts)
    note = f"{counts.size} stamps for {time_s.size} samples: spread evenly between stamps"
    return replace(stamps, time_s=time_s), (note,)


def timeline(stamps: Stamps) -> Timeline:
    """Rebuild the times of samples from their stamps.

    Samples out of order are sorted; of several with the same stamps, the first is kept.

    Raises
    ------
    InvalidInputError
        If there is neither a clock nor a counter with a known and possible period, or the times contradict
        the period.
    """
    numbers = None if stamps.counter is None else _sample_numbers(stamps.counter, stamps.extras)
    values = stamps.time_s
    if values is None:
        if numbers is None or not stamps.period_s > 0.0:
            evidence = "neither" if numbers is None else "a counter, but no rate"
            raise InvalidInputError(
                f"expected samples with a clock, or with a sampling rate, got {evidence}: give --rate-hz"
            )
        require_rate(1.0 / stamps.period_s, "sampling rate")
        values = numbers * stamps.period_s
    anew = _new_starts(values, stamps)
    if anew.any():  # each start far behind all before it, to sort them
        steps = np.diff(values)
        steps[anew[1:]] = LATE * usual_step(steps)
        values = _running_sums(steps)
    notes, rows = list[str](), np.argsort(values, kind="stable")
    rank = np.argsort(rows)
    if late := int((rank < np.maximum.accumulate(rank)).sum()):
        notes.append(f"{late} samples came out of order and were sorted")
    distinct = np.append(True, np.diff(values[rows]) > 0.0)
    if left_out := int((~distinct).sum()):
        notes.append(f"{left_out} samples at the time of another were left out")
        rows = rows[distinct]
    if not (late or left_out):
        return _build(stamps, values, numbers, anew[1:], notes)
    anew, numbers = np.diff(np.cumsum(anew)[rows]) > 0, None if numbers is None else numbers[rows]
    return replace(_build(stamps[rows], values[rows], numbers, anew, notes), rows=rows)


def _running_sums(steps: Any) -> Any:
    """Sums of steps, from zero on."""
    return np.append(steps.dtype.type(0), np.cumsum(steps))


def usual_step(steps: FloatArray, none: float = 1.0) -> float:
    """Median of the steps forward, or what it is taken for if there is none."""
    forward = steps[steps > 0]
    return float(np.median(forward)) if forward.size else none


def _sample_numbers(counter: IntArray, extras: IntArray | None) -> FloatArray:
    """Numbers of samples by the counter, which may count several for each, and other messages."""
    numbers = counter if extras is None else counter - extras
    usual, often = np.unique(np.diff(numbers), return_counts=True)
    stride = int(np.gcd.reduce(np.maximum(usual[often >= max(_RARE * numbers.size, 1.0)], 0))) or 1
    return np.asarray(numbers / stride)


def _new_starts(values: FloatArray, stamps: Stamps) -> BoolArray:
    """Mark the samples before which the sensor was started anew.

    A step far back shows it, unless those overtaken were followed by a jump forward to where it was.
    """
    steps = np.diff(values)
    usual = usual_step(steps)
    anew = np.zeros(values.size, dtype=bool)
    back = np.flatnonzero(steps < -LATE * usual)
    anew[back + 1] = True
    for i in back[:_OVERTAKINGS].tolist():
        later = values[i + 1 :] > values[i]
        anew[i + 1] = not later.any() or steps[i + int(np.argmax(later))] < _LONGER * usual
    if stamps.time_s is None and stamps.starts is not None:
        anew |= stamps.starts
    elif stamps.computer_s is not None:
        anew |= np.isfinite(stamps.computer_s)
    anew[0] = False
    return anew


def _build(
    stamps: Stamps, values: FloatArray, numbers: FloatArray | None, anew: BoolArray, notes: list[str]
) -> Timeline:
    """Times, rising counter and gaps of samples in order, without repeats."""
    seconds, irregular = np.diff(values), False
    period_s = float(np.median(seconds[~anew])) if (~anew).any() else float("nan")
    if numbers is None:
        periods, irregular = _by_clock(seconds, anew)
    else:
        periods = np.maximum(np.diff(numbers), 1.0)
        if stamps.time_s is None:
            period_s, seconds = stamps.period_s, periods * stamps.period_s
    if contradiction := _stated_otherwise(stamps, seconds, anew):
        if numbers is not None:
            raise InvalidInputError(contradiction)
        notes.append(f"{contradiction}, which holds")
    if irregular:
        shortest, longest = 1e3 * seconds.min(), 1e3 * seconds.max()
        notes.append(
            f"irregular clock, steps of {shortest:.3g} to {longest:.3g} ms: single losses cannot be told"
        )
    if anew.any():
        pauses = _pauses(stamps, anew, seconds)
        certain = anew & np.isfinite(pauses)
        seconds = np.where(anew, np.where(certain, pauses, UNKNOWN_PAUSE_S), seconds)
        notes.append(
            f"the sensor started anew {anew.sum()} times; the pause is by the computer's clock "
            f"{certain.sum()} times, else not known and taken as {UNKNOWN_PAUSE_S:g} s"
        )
    long = (seconds > _LONGER * period_s) & (not irregular)
    at = np.flatnonzero((periods > 1.5) | anew | long)
    missing = np.where(anew[at], 0, np.round(np.minimum(periods[at], _MOST_PERIODS)) - 1)
    gaps = tuple(Gap(int(i), int(count), float(seconds[i])) for i, count in zip(at, missing, strict=True))
    time_s, counter = stamps.time_s, stamps.counter
    if time_s is None or anew.any():
        time_s = (0.0 if time_s is None else time_s[0]) + _running_sums(seconds)
    if counter is not None:
        counter = counter[0] + _running_sums(np.maximum(np.diff(counter), 1))
    return Timeline(slice(None), time_s, counter, gaps, tuple(notes))


def _stated_otherwise(stamps: Stamps, seconds: FloatArray, anew: BoolArray) -> str:
    """Sentence on a stated rate that is neither the samples' nor the counter's by their clock."""
    going = (seconds > 0.0) & ~anew
    if not (stamps.period_s > 0.0 and going.any()):
        return ""
    rates = [float(np.median(1.0 / seconds[going]))]
    if stamps.counter is not None:
        rates.append(float(np.median(np.diff(stamps.counter)[going] / seconds[going])))
    if any(1.0 / _AGREES < rate * stamps.period_s < _AGREES for rate in rates):
        return ""
    stated_hz = 1.0 / stamps.period_s
    return f"expected times at the stated rate, {stated_hz:g} Hz, got {rates[0]:.4g} Hz by their clock"


def _by_clock(seconds: FloatArray, anew: BoolArray) -> tuple[FloatArray, bool]:
    """Whole periods of each step; whether the clock is irregular: jitter makes short steps, losses none."""
    running = seconds[~anew]
    if not running.size:
        return np.ones(seconds.size), False
    period_s = running[running < 2.5 * np.median(running)].mean()
    periods = seconds / period_s
    irregular = bool(np.mean(running < _SHORTER * period_s) > _RARE)
    return np.where(periods > (_MUCH_LONGER if irregular else _LONGER), np.round(periods), 1.0), irregular


def _pauses(stamps: Stamps, anew: BoolArray, seconds: FloatArray) -> FloatArray:
    """Pause before each new start by the computer's clock, shape (m - 1,); NaN where that is not known."""
    pauses = np.full(anew.size, np.nan)
    if stamps.computer_s is None:
        return pauses
    running = _running_sums(np.where(anew, 0.0, seconds))
    behind = stamps.computer_s - running  # constant while the sensor runs, and larger by each pause
    for before, after in pairwise(np.flatnonzero(np.isfinite(behind))):
        if anew[before:after].sum() == 1:
            pauses[after - 1] = behind[after] - behind[before]
    return np.where(pauses > 0.0, pauses, np.nan)
