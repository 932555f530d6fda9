"""Rebuild the times of samples and find missing ones from the sensor's counter and clock.

Counter and clock wrap round; both are unwrapped. A sensor that was unplugged starts
both anew: the length of that pause is known only from the computer's clock, if the recording holds it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from xsens.logs.samples import Gap, median

UNKNOWN_PAUSE_S = 1.0
"""Assumed pause before a new start of unknown length; longer than interpolation bridges."""

SHORTEST_S = 4e-4
"""No sensor's samples are closer: they end at 2 kHz."""

COUNTS, TICKS, TICK_S = 1 << 16, 1 << 32, 1e-4
"""Where the sensors' counter and clock wrap round, and the clock's unit."""

_RARE = 0.01
_LONGER, _MUCH_LONGER = 1.6, 10.0
"""A clock step of more periods is a gap; the latter if the clock is irregular."""

_SHORTER = 0.6
"""A loss makes no step shorter than the period, rounding to 10 ms at 64 Hz none below this share of it."""

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
    extras : ndarray of int, shape (m,), optional
        Number of messages before each sample that the sensor counted, but that were no samples.
    computer_s : ndarray, shape (m,), or NaN
        The computer's clock where it was recorded before a sample, as at each new start; NaN elsewhere.
    """

    counter: IntArray | None = None
    time_s: FloatArray | None = None
    period_s: float = np.nan
    extras: IntArray | None = None
    computer_s: FloatArray | float = np.nan


@dataclass(frozen=True)
class Timeline:
    """Times of the samples that are kept (of those sent twice, one), with their counter made to rise.

    `rows` are the indices of those samples in order of time.
    """

    rows: IntArray
    time_s: FloatArray
    counter: IntArray | None
    gaps: tuple[Gap, ...]
    notes: tuple[str, ...]


def unwrap(values: Any, span: int) -> Any:
    """Unwrap a counter or clock that wraps round at a span; one that never falls stays as it is."""
    return values if (np.diff(values) >= 0).all() else np.unwrap(values, period=span)


def timeline(stamps: Stamps, readings: Sequence[FloatArray] = ()) -> Timeline:
    """Rebuild the times of samples from their stamps.

    Samples out of order are sorted; of several with the same stamps, the first is kept. Those that came
    together, stamped on arrival, are spread over the time since those before, if their readings differ.

    Raises
    ------
    InvalidInputError
        If there is neither a clock nor a counter with a known and possible period, or the times contradict
        the period.
    """
    values, notes = stamps.time_s, list[str]()
    numbers: Any = None if stamps.counter is None else _sample_numbers(stamps.counter, stamps.extras)
    if values is None:
        if not stamps.period_s > 0.0:
            evidence = "neither" if numbers is None else "a counter, but no rate"
            raise InvalidInputError(
                "expected samples with a clock, as a column time_s, or with a sampling rate, got "
                f"{evidence}: give --rate-hz"
            )
        if numbers is None:
            notes.append("samples have no counter: losses cannot be found")
            numbers = np.arange(len(readings[0]) if readings else np.size(stamps.computer_s))
        values = (numbers - numbers[0]) * stamps.period_s
    elif (stamps_s := _spread(values, readings)) is not values:
        notes.append(f"several samples to a stamp, {len(values)} in all: spread evenly between stamps")
        values = stamps_s
    anew = _new_starts(values, stamps.computer_s)
    if anew.any():
        steps = np.where(anew[1:], 0.0, np.diff(values))
        behind = stamps.computer_s - _running_sums(
            steps
        )  # constant while the sensor runs, and larger by each pause
        pauses = np.diff(behind[np.append(0, np.flatnonzero(anew))])
        certain = pauses > 0.0
        steps[anew[1:]] = np.where(certain, pauses, UNKNOWN_PAUSE_S)
        values = values[0] + _running_sums(steps)
        notes.append(
            f"the sensor started anew {anew.sum()} times; the pause is by the computer's clock "
            f"{certain.sum()} times, else not known and taken as {UNKNOWN_PAUSE_S:g} s"
        )
    rows = np.argsort(values, kind="stable")
    rank = np.argsort(rows)
    if late := (rank < np.maximum.accumulate(rank)).sum():
        notes.append(f"{late} samples came out of order and were sorted")
    distinct = np.append(True, np.diff(values[rows]) > 0.0)
    if left_out := (~distinct).sum():
        notes.append(f"{left_out} samples at the time of another were left out")
    rows = rows[distinct]
    time_s, anew = values[rows], np.diff(np.cumsum(anew)[rows]) > 0
    counter, numbers = (None if part is None else part[rows] for part in (stamps.counter, numbers))
    counter, gaps, more = _gaps(time_s, counter, numbers, anew, stamps.period_s)
    return Timeline(rows, time_s, counter, gaps, (*notes, *more))


def _spread(values: FloatArray, readings: Sequence[FloatArray]) -> Any:
    """Times of samples that came together, stamped on arrival, spread over the time since those before.

    Rows of readings that repeat the one before are the same sample, sent twice.
    """
    steps = np.diff(values)
    together = (steps >= 0.0) & (steps < SHORTEST_S)
    differ = np.any([(rows[1:] != rows[:-1]).any(axis=1) for rows in readings], axis=0)
    if together.all() or 2 * (together & differ).sum() <= steps.size:
        return values
    last = np.flatnonzero(np.append(~together, True))
    counts, arrival_s = np.diff(last, prepend=-1), values[last]
    spans = np.diff(arrival_s) / counts[1:]
    usual = median(spans)
    period_s = np.append(usual, np.minimum(spans, _LONGER * usual))
    places = np.arange(values.size) - np.repeat(last, counts)
    return np.repeat(arrival_s, counts) + places * np.repeat(period_s, counts)


def _gaps(
    time_s: FloatArray, counter: Any, numbers: Any, anew: BoolArray, stated_s: float
) -> tuple[IntArray | None, tuple[Gap, ...], list[str]]:
    """A rising counter, gaps between samples by it or else by the clock, and notes on their rate."""
    seconds, notes = np.diff(time_s), list[str]()
    running = seconds[~anew]
    usual_s, longest = usual_step(running), _LONGER
    regular = running[running < 2.5 * usual_s]
    period_s = float(regular.sum() / max(regular.size, 1)) or 1.0
    periods = seconds / period_s
    rates_hz = [1.0 / running]
    if counter is not None:
        counts, periods = np.diff(counter), np.diff(numbers)
        counter = counter[0] + _running_sums(np.maximum(counts, 1))
        rates_hz.append(counts[~anew] / running)
    elif (running < _SHORTER * period_s).sum() > _RARE * running.size:
        longest = _MUCH_LONGER
        span = f"{1e3 * seconds.min():.3g} to {1e3 * seconds.max():.3g} ms"
        notes.append(f"irregular clock, steps of {span}: single losses cannot be told")
    medians_hz = [median(rates) for rates in rates_hz if running.size and stated_s > 0.0]
    if medians_hz and not any(1.0 / _AGREES < hz * stated_s < _AGREES for hz in medians_hz):
        contradiction = (
            f"expected times at the stated rate, {1.0 / stated_s:g} Hz, got {medians_hz[0]:.4g} Hz by their "
            "clock"
        )
        if counter is not None:
            raise InvalidInputError(contradiction)
        notes.append(f"{contradiction}, which holds")
    missing = np.where(anew | (periods <= longest), 0.0, np.round(periods) - 1.0)
    at = np.flatnonzero((missing > 0.0) | anew | (seconds > longest * usual_s))
    gaps = tuple(Gap(int(i), int(missing[i]), float(seconds[i])) for i in at)
    return counter, gaps, notes


def _running_sums(steps: Any) -> Any:
    """Sums of steps, from zero on."""
    return np.append(steps.dtype.type(0), np.cumsum(steps))


def usual_step(steps: FloatArray, none: float = 1.0) -> Any:
    """Median of the steps forward, or what it is taken for if there is none."""
    return median(steps[steps > 0], none)


def _sample_numbers(counter: IntArray, extras: IntArray | None) -> FloatArray:
    """Numbers of samples by the counter, which may count several for each, and other messages."""
    numbers = counter if extras is None else counter - extras
    usual, often = np.unique(np.diff(numbers), return_counts=True)
    stride = int(np.gcd.reduce(np.maximum(usual[often >= max(_RARE * numbers.size, 1.0)], 0))) or 1
    return numbers / stride


def _new_starts(values: FloatArray, computer_s: FloatArray | float) -> BoolArray:
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
    anew |= np.isfinite(computer_s)
    anew[0] = False
    return anew
