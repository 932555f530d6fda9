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
    period_s : float
        Sampling period as configured; NaN if not known.
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


def timeline(stamps: Stamps) -> Timeline:
    """Rebuild the times of samples from their stamps.

    Raises
    ------
    InvalidInputError
        If there is neither a clock nor a counter with a known and possible period.
    """
    if stamps.period_s > 0.0:
        require_rate(1.0 / stamps.period_s, "sampling rate")
    elif stamps.ticks is None:
        got = "neither" if stamps.counter is None else "a counter, but no rate"
        raise InvalidInputError(
            f"expected samples with a clock, or with a sampling rate, got {got}: give --rate-hz"
        )
    order = _order_of(stamps)
    stamps = stamps if order is None else _taken(stamps, order)
    same = [np.diff(values) == 0 for values in (stamps.counter, stamps.ticks) if values is not None]
    if stamps.starts is not None:
        same.append(~stamps.starts[1:])
    kept = np.concatenate(([True], ~np.logical_and.reduce(same)))
    if not kept.all():
        stamps = _taken(stamps, kept)
    steps, counts = _steps(stamps)
    told = (*_order_notes(order), *steps.notes(int((~kept).sum()), "came twice; the second was"))
    time_s = _risen(0.0 if stamps.ticks is None else float(stamps.ticks[0]) * stamps.tick_s, steps.seconds)
    gaps = steps.gaps()
    del steps  # a large log's arrays, of which few may be held at once
    first = 0 if stamps.counter is None else int(stamps.counter[0])
    rows = None if order is None and kept.all() else (np.arange(kept.size) if order is None else order)[kept]
    return Timeline(rows, time_s, None if counts is None else _risen(first, counts), gaps, told)


def _taken(stamps: Stamps, which: Any) -> Stamps:
    arrays: dict[str, Any] = {k: v[which] for k, v in vars(stamps).items() if isinstance(v, np.ndarray)}
    return replace(stamps, **arrays)


def _order_of(stamps: Stamps) -> IntArray | None:
    """Indices that put samples which came late, by counter or else clock, in order; None if none did."""
    values, span = stamps.counter, stamps.counter_span
    late = _LATE
    if values is None:
        assert stamps.ticks is not None  # one of the two is there
        values, span = stamps.ticks, _TICK_SPAN
        steps = np.diff(values) % span
        usual = np.median(steps[steps < span // 2]) if (steps < span // 2).any() else 0
        late = int(_LATE * usual)
    signed = (np.diff(values) + span // 2) % span - span // 2
    back = (signed < 0) & (signed >= -late)
    if stamps.starts is not None:
        back &= ~stamps.starts[1:]
    if not back.any():
        return None
    signed[(signed < -late) | (signed > span // 4)] = late  # a new start
    if stamps.starts is not None:
        signed[stamps.starts[1:]] = late
    return np.asarray(np.argsort(np.append(0, np.cumsum(signed)), kind="stable"))


def _order_notes(order: IntArray | None) -> tuple[str, ...]:
    if order is None:
        return ()
    rank = np.argsort(order)
    late = int((rank < np.maximum.accumulate(rank)).sum())
    return (f"{late} samples came out of order and were sorted",)


def _risen(first: float, steps: Any) -> Any:
    """Running sum of steps from `first` on, shape (steps + 1,)."""
    sums = np.empty(steps.size + 1, dtype=steps.dtype)
    sums[0] = 0
    np.cumsum(steps, out=sums[1:])
    sums += steps.dtype.type(first)
    return sums


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
    order = None if (np.diff(time_s) >= 0.0).all() else np.argsort(time_s, kind="stable")
    time_s = time_s if order is None else time_s[order]
    kept = np.append(True, np.diff(time_s) > 0.0)
    rows = None if order is None and kept.all() else (np.arange(kept.size) if order is None else order)[kept]
    time_s = time_s[kept]
    counter = counter if counter is None or rows is None else counter[rows]
    seconds = np.diff(time_s)
    never = np.zeros(seconds.size, dtype=bool)
    period_s = float(np.median(seconds)) if seconds.size else float("nan")
    if counter is None:
        taken, irregular = _by_clock(seconds, never)
    else:
        counts = np.diff(counter)
        if (counts < 0).any():
            counts %= _WORD
            counter = _risen(int(counter[0]), counts)
        taken, irregular = _by_counter(counts, never), False
        _require_agreement(seconds, counts, stated_hz)
    steps = _Steps(seconds, taken, never, never, period_s, irregular)
    notes = (*_order_notes(order), *steps.notes(int((~kept).sum()), "at the time of another were"))
    return Timeline(rows, time_s, counter, steps.gaps(), notes)


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


@dataclass(frozen=True)
class _Steps:
    """Steps from each kept sample to the next: seconds, sampling periods, and new starts.

    `unknown` marks new starts after a pause of unknown length; `irregular` is true if the clock's steps vary
    too much to tell single losses.
    """

    seconds: FloatArray
    taken: FloatArray
    anew: BoolArray
    unknown: BoolArray
    period_s: float
    irregular: bool = False

    def gaps(self) -> tuple[Gap, ...]:
        """Steps in which samples are missing, and pauses."""
        long = (self.seconds > _LONGER * self.period_s) & (not self.irregular)
        at = np.flatnonzero((self.taken > 1.5) | self.anew | long)
        missing = np.where(self.anew[at], 0, np.round(np.minimum(self.taken[at], _MOST_PERIODS)) - 1)
        return tuple(
            Gap(int(i), int(lost), float(self.seconds[i])) for i, lost in zip(at, missing, strict=True)
        )

    def notes(self, left_out: int, why: str) -> tuple[str, ...]:
        """How many were left out and why, an irregular clock, and new starts."""
        notes = [f"{left_out} samples {why} left out"] if left_out else []
        if self.irregular:
            shortest, longest = 1e3 * self.seconds.min(), 1e3 * self.seconds.max()
            notes.append(
                f"irregular clock, steps of {shortest:.3g} to {longest:.3g} ms: single losses cannot be told"
            )
        if self.anew.any():
            told = int((self.anew & ~self.unknown).sum())
            notes.append(
                f"the sensor started anew {self.anew.sum()} times; the pause is by the computer's clock "
                f"{told} times, else not known and taken as {UNKNOWN_PAUSE_S:g} s"
            )
        return tuple(notes)


def _steps(stamps: Stamps) -> tuple[_Steps, IntArray | None]:
    """Steps, and the rise of the counter in each."""
    span, period_s, irregular = stamps.counter_span, stamps.period_s, False
    counts = None if stamps.counter is None else np.diff(stamps.counter) % span
    ticks = None if stamps.ticks is None else np.diff(stamps.ticks) % _TICK_SPAN
    anew = _starts_anew(stamps, counts, ticks)
    seconds = None if ticks is None else np.asarray(ticks * stamps.tick_s)
    if seconds is not None and not period_s > 0.0:
        period_s = float(np.median(seconds[~anew])) if (~anew).any() else float("nan")
    if counts is None:
        assert seconds is not None  # one of the two is there
        taken, irregular = _by_clock(seconds, anew)
    else:
        taken = _by_counter(counts if stamps.others is None else counts - np.diff(stamps.others), anew)
        if seconds is not None and stamps.period_s > 0.0:
            _require_agreement(seconds[~anew], counts[~anew], 1.0 / stamps.period_s)
        if seconds is None:
            seconds = taken * period_s
        elif period_s > 0.0:  # the clock tells how often the counter went all the way round
            rounds = np.maximum(np.round((seconds / period_s - taken) / span), 0.0)
            counts, taken = counts + rounds.astype(np.int64) * span, taken + rounds * span
    unknown = anew
    if anew.any():
        pauses = _pauses(stamps, anew, seconds)
        unknown = anew & np.isnan(pauses)
        seconds = np.where(anew, np.where(unknown, UNKNOWN_PAUSE_S, pauses), seconds)
    return _Steps(seconds, taken, anew, unknown, period_s, irregular), counts


def _starts_anew(stamps: Stamps, counts: IntArray | None, ticks: IntArray | None) -> BoolArray:
    """Mark steps over which the sensor's clock, or else its counter, went back or was reset."""
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
