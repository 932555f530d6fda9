"""Rebuild the times of samples and find missing ones from the sensor's counter and clock.

A counter of 16 bits and a clock of 32 bits wrap round; both are unwrapped. A sensor that was unplugged starts
both anew: the length of that pause is known only from the computer's clock, if the recording holds it.
"""

from __future__ import annotations

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

_WORD, _TICK_SPAN = 1 << 16, 1 << 32
_RARE = 0.01
_LONGER, _MUCH_LONGER = 1.6, 10.0
"""A clock step of more periods is a gap; the latter if the clock is irregular."""

_SHORTER = 0.6
"""A loss makes no step shorter than the period, rounding to 10 ms at 64 Hz none below this share of it."""

_MOST_PERIODS = 2.0**53

_LATE = 64
"""A sample that comes at most so many samples late was overtaken; one further back shows a new start."""

_AGREES = 1.1
"""Ratio up to which a stated rate and that of the times agree: clocks of sensors are good to 1 %."""


@dataclass(frozen=True)
class Stamps:
    """Time stamps of `m` samples as sent.

    Attributes
    ----------
    counter, ticks : ndarray of int, shape (m,), optional
        As sent, wrapping round: the counter at `counter_span`, the ticks, of `tick_s` each, at 2**32.
    time_s : ndarray, shape (m,), optional
        Times, in place of ticks.
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
    ticks: IntArray | None = None
    counter_span: int = 1 << 16
    tick_s: float = 1e-4
    period_s: float = float("nan")
    others: IntArray | None = None
    starts: BoolArray | None = None
    computer_s: FloatArray | None = None
    time_s: FloatArray | None = None


@dataclass(frozen=True)
class Timeline:
    """Times of the samples that are kept (of those sent twice, one), with their counter made to rise.

    `rows` are the indices of those samples in order of time; None if they are all, in their order.
    """

    rows: IntArray | None
    time_s: FloatArray
    counter: IntArray | None = None
    gaps: tuple[Gap, ...] = ()
    notes: tuple[str, ...] = ()


def require_rate(rate_hz: float, what: str) -> None:
    """Raise `InvalidInputError` if no sensor has such a sampling rate."""
    low, high = _RATES_HZ
    if not low <= rate_hz <= high:
        raise InvalidInputError(f"{what}: expected {low:g} to {high:g} Hz, got {rate_hz:g}")


def timeline_of_times(
    time_s: FloatArray, counter: IntArray | None = None, stated_hz: float = float("nan")
) -> Timeline:
    """Find gaps in samples that have times, and perhaps a counter.

    Samples out of order are sorted; of several at one time, the first is kept.

    Raises
    ------
    InvalidInputError
        If the times contradict a stated sampling rate.
    """
    return timeline(Stamps(counter, time_s=time_s, period_s=1.0 / stated_hz if stated_hz else np.nan))


def timeline(stamps: Stamps) -> Timeline:
    """Rebuild the times of samples from their stamps.

    Raises
    ------
    InvalidInputError
        If there is neither a clock nor a counter with a known and possible period, or the times contradict
        the period.
    """
    if stamps.time_s is None and stamps.period_s > 0.0:
        require_rate(1.0 / stamps.period_s, "sampling rate")
    elif stamps.time_s is None and stamps.ticks is None:
        got = "neither" if stamps.counter is None else "a counter, but no rate"
        raise InvalidInputError(
            f"expected samples with a clock, or with a sampling rate, got {got}: give --rate-hz"
        )
    order = _order_of(stamps)
    stamps = stamps if order is None else _taken(stamps, order)
    kept = np.append(True, ~_repeats(stamps))
    if not kept.all():
        stamps = _taken(stamps, kept)
    notes = []
    if order is not None:
        rank = np.argsort(order)
        late = int((rank < np.maximum.accumulate(rank)).sum())
        notes.append(f"{late} samples came out of order and were sorted")
    if left_out := int((~kept).sum()):
        why = "came twice; the second was" if stamps.time_s is None else "at the time of another were"
        notes.append(f"{left_out} samples {why} left out")
    rows = None if order is None and kept.all() else (np.arange(kept.size) if order is None else order)[kept]
    seconds, counts, gaps, told = _steps(stamps)
    if (time_s := stamps.time_s) is None:
        first_s = 0.0 if stamps.ticks is None else float(stamps.ticks[0]) * stamps.tick_s
        time_s = _risen(first_s, seconds)
    counter = None if stamps.counter is None else _risen(int(stamps.counter[0]), counts)
    return Timeline(rows, time_s, counter, gaps, (*notes, *told))


def _taken(stamps: Stamps, which: Any) -> Stamps:
    arrays: dict[str, Any] = {k: v[which] for k, v in vars(stamps).items() if isinstance(v, np.ndarray)}
    return replace(stamps, **arrays)


def _repeats(stamps: Stamps) -> BoolArray:
    """Steps from a sample to the same one."""
    if stamps.time_s is not None:
        return np.asarray(np.diff(stamps.time_s) == 0.0)
    same = [np.diff(values) == 0 for values in (stamps.counter, stamps.ticks) if values is not None]
    if stamps.starts is not None:
        same.append(~stamps.starts[1:])
    return np.asarray(np.logical_and.reduce(same))


def _order_of(stamps: Stamps) -> IntArray | None:
    """Indices that put samples which came late, by time, counter or clock, in order; None if none did."""
    if stamps.time_s is not None:
        rises = bool((np.diff(stamps.time_s) >= 0.0).all())
        return None if rises else np.argsort(stamps.time_s, kind="stable")
    values, span = stamps.counter, stamps.counter_span
    late = _LATE
    if values is None:
        assert stamps.ticks is not None  # one of the two is there
        values, span = stamps.ticks, _TICK_SPAN
        steps = np.diff(values) % span
        usual = np.median(steps[steps < span // 2]) if (steps < span // 2).any() else 0
        late = int(_LATE * usual)
    signed = (np.diff(values) + span // 2) % span - span // 2
    anew = np.zeros(signed.size, dtype=bool) if stamps.starts is None else stamps.starts[1:]
    if not ((signed < 0) & (signed >= -late) & ~anew).any():
        return None
    signed[(signed < -late) | (signed > span // 4) | anew] = late  # a new start
    return np.asarray(np.argsort(np.append(0, np.cumsum(signed)), kind="stable"))


def _risen(first: float, steps: Any) -> Any:
    """Running sum of steps from `first` on, shape (steps + 1,)."""
    sums = np.empty(steps.size + 1, dtype=steps.dtype)
    sums[0] = 0
    np.cumsum(steps, out=sums[1:])
    sums += steps.dtype.type(first)
    return sums


def _steps(stamps: Stamps) -> tuple[FloatArray, Any, tuple[Gap, ...], list[str]]:
    """Steps from each sample to the next: seconds, rise of the counter, gaps, and notes."""
    span, period_s, irregular, notes = stamps.counter_span, stamps.period_s, False, []
    counts = None if stamps.counter is None else np.diff(stamps.counter)
    if counts is not None and (counts < 0).any():
        counts %= span
    ticks = None if stamps.ticks is None else np.diff(stamps.ticks) % _TICK_SPAN
    seconds = np.asarray(ticks * stamps.tick_s) if ticks is not None else None
    anew = _starts_anew(stamps, counts, ticks)
    if stamps.time_s is not None:
        seconds, period_s = np.diff(stamps.time_s), np.nan
    if seconds is not None and not period_s > 0.0:
        period_s = float(np.median(seconds[~anew])) if (~anew).any() else float("nan")
    if counts is None:
        assert seconds is not None  # one of the two is there
        taken, irregular = _by_clock(seconds, anew)
    else:
        taken = _by_counter(counts if stamps.others is None else counts - np.diff(stamps.others), anew)
        if seconds is None:
            seconds = taken * period_s
        else:
            _require_agreement(seconds[~anew], counts[~anew], 1.0 / stamps.period_s)
        if (
            ticks is not None and period_s > 0.0
        ):  # the clock tells how often the counter went all the way round
            rounds = np.maximum(np.round((seconds / period_s - taken) / span), 0.0)
            counts, taken = counts + rounds.astype(np.int64) * span, taken + rounds * span
    if irregular:
        shortest, longest = 1e3 * seconds.min(), 1e3 * seconds.max()
        notes.append(
            f"irregular clock, steps of {shortest:.3g} to {longest:.3g} ms: single losses cannot be told"
        )
    if anew.any():
        pauses = _pauses(stamps, anew, seconds)
        told = anew & np.isfinite(pauses)
        seconds = np.where(anew, np.where(told, pauses, UNKNOWN_PAUSE_S), seconds)
        notes.append(
            f"the sensor started anew {anew.sum()} times; the pause is by the computer's clock "
            f"{told.sum()} times, else not known and taken as {UNKNOWN_PAUSE_S:g} s"
        )
    long = (seconds > _LONGER * period_s) & (not irregular)
    at = np.flatnonzero((taken > 1.5) | anew | long)
    missing = np.where(anew[at], 0, np.round(np.minimum(taken[at], _MOST_PERIODS)) - 1)
    gaps = tuple(Gap(int(i), int(lost), float(seconds[i])) for i, lost in zip(at, missing, strict=True))
    return seconds, counts, gaps, notes


def _require_agreement(seconds: FloatArray, counts: IntArray, stated_hz: float) -> None:
    """Raise if a stated rate is neither that of the samples nor that of the counter by their clock."""
    going = (seconds > 0.0) & (counts > 0)
    if not (stated_hz > 0.0 and going.any()):
        return
    rates = (float(np.median(1.0 / seconds[going])), float(np.median(counts[going] / seconds[going])))
    if not any(1.0 / _AGREES < rate / stated_hz < _AGREES for rate in rates):
        raise InvalidInputError(
            f"expected times at the stated rate, {stated_hz:g} Hz, got {rates[0]:.4g} Hz by their clock"
        )


def _starts_anew(stamps: Stamps, counts: IntArray | None, ticks: IntArray | None) -> BoolArray:
    """Mark steps over which the sensor's clock, or else its counter, went back or was reset."""
    if stamps.time_s is not None:
        return np.zeros(stamps.time_s.size - 1, dtype=bool)
    if ticks is not None:
        anew = (ticks > _TICK_SPAN // 2) | (ticks == 0)
        known = None if stamps.computer_s is None else np.isfinite(stamps.computer_s)
    else:
        assert counts is not None
        anew, known = counts > stamps.counter_span // 2, stamps.starts
    return anew if known is None else np.asarray(anew | known[1:])


def _by_counter(counts: IntArray, anew: BoolArray) -> FloatArray:
    """Sampling periods of each step of the counter; a sensor may count several for each sample."""
    often = np.bincount(np.clip(counts[~anew] if anew.any() else counts, 0, _WORD))
    stride = int(np.gcd.reduce(np.flatnonzero(often >= max(_RARE * counts.size, 1.0)))) or 1
    taken = counts / stride
    return np.asarray(np.maximum(taken, 1.0, out=taken))


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
    running = np.concatenate(([0.0], np.cumsum(np.where(anew, 0.0, seconds))))
    behind = stamps.computer_s - running  # constant while the sensor runs, and larger by each pause
    for before, after in pairwise(np.flatnonzero(np.isfinite(behind))):
        if anew[before:after].sum() == 1:
            pauses[after - 1] = behind[after] - behind[before]
    return np.where(pauses > 0.0, pauses, np.nan)
