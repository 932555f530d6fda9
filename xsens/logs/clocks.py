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

_TICK_SPAN = 1 << 32
_RARE = 0.01
_FEW = 1 << 20
"""Largest step of a counter up to which steps are counted one by one."""
_LONGER = 1.6
"""A clock step of more periods is a gap, unless the clock is irregular."""

_LONGER_STILL = (2.5, 10.0, float("inf"))
"""Other limits, used if they agree better with a constant rate."""


@dataclass(frozen=True)
class Stamps:
    """Time stamps of `m` samples as sent.

    Attributes
    ----------
    counter, ticks : ndarray of int, shape (m,), optional
        As sent, wrapping round.
    counter_span : int
        Value at which the counter wraps round to 0.
    tick_s : float
        Duration of a tick.
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
    """Times of the samples that are kept.

    Attributes
    ----------
    kept : ndarray of bool, shape (m,)
        False for repeated samples.
    time_s : ndarray, shape (kept,)
    counter : ndarray of int, shape (kept,), optional
    gaps : tuple of Gap
    notes : tuple of str
    """

    kept: BoolArray
    time_s: FloatArray
    counter: IntArray | None = None
    gaps: tuple[Gap, ...] = ()
    notes: tuple[str, ...] = ()


def timeline(stamps: Stamps) -> Timeline:
    """Rebuild the times of samples from their stamps.

    Raises
    ------
    InvalidInputError
        If there is neither a clock nor a counter with a known period.
    """
    if stamps.ticks is None and (stamps.counter is None or not stamps.period_s > 0.0):
        what = "neither" if stamps.counter is None else "a counter, but no sampling rate"
        raise InvalidInputError(f"expected samples with a clock, or with a counter and a rate, got {what}")
    kept = _first_of_repeats(stamps)
    steps = _steps(stamps if kept.all() else _only(stamps, kept))
    origin = 0.0 if stamps.ticks is None else float(stamps.ticks[0]) * stamps.tick_s
    time_s = origin + np.concatenate(([0.0], np.cumsum(steps.seconds)))
    notes = _notes(int((~kept).sum()), steps)
    return Timeline(kept, time_s, _risen(stamps, steps), _gaps(steps), notes)


def timeline_of_times(time_s: FloatArray, counter: IntArray | None = None) -> Timeline:
    """Find repeats and gaps in samples that have times, and perhaps a counter that does not wrap round.

    Samples not later than all before them are left out.
    """
    before = np.concatenate(([-np.inf], np.maximum.accumulate(time_s)[:-1]))
    kept = time_s > before
    time_s, counter = time_s[kept], None if counter is None else counter[kept]
    seconds = np.diff(time_s)
    period_s = float(np.median(seconds)) if seconds.size else float("nan")
    samples = None if counter is None else _samples(np.diff(counter), None, np.zeros(seconds.size, bool))
    never = np.zeros(seconds.size, dtype=bool)
    missing, irregular = _missing(seconds, samples, period_s, 1 << 62, never)
    steps = _Steps(seconds, missing, never, never, period_s, None, irregular)
    late = int((~kept).sum())
    notes = (f"{late} samples whose time did not rise were left out",) if late else ()
    return Timeline(kept, time_s, counter, _gaps(steps), (*notes, *_notes(0, steps)))


def _first_of_repeats(stamps: Stamps) -> BoolArray:
    """False for a sample with the same stamps as the one before."""
    same = [np.diff(values) == 0 for values in (stamps.counter, stamps.ticks) if values is not None]
    repeated = np.logical_and.reduce(same)
    if stamps.starts is not None:
        repeated &= ~stamps.starts[1:]
    return np.concatenate(([True], ~repeated))


def _only(stamps: Stamps, kept: BoolArray) -> Stamps:
    arrays: dict[str, Any] = {
        name: value for name, value in vars(stamps).items() if isinstance(value, np.ndarray)
    }
    return replace(stamps, **{name: values[kept] for name, values in arrays.items()})


@dataclass(frozen=True)
class _Steps:
    """Steps from each kept sample to the next: seconds, samples missing between, and new starts.

    `counts` is the rise of the counter; `unknown` marks new starts after a pause of unknown length;
    `irregular` is true if the clock's steps vary too much to tell single losses.
    """

    seconds: FloatArray
    missing: IntArray
    anew: BoolArray
    unknown: BoolArray
    period_s: float
    counts: IntArray | None
    irregular: bool = False


def _steps(stamps: Stamps) -> _Steps:
    span = stamps.counter_span
    counts = None if stamps.counter is None else np.diff(stamps.counter) % span
    ticks = None if stamps.ticks is None else np.diff(stamps.ticks) % _TICK_SPAN
    anew = _starts_anew(stamps, counts, ticks)
    samples = _samples(counts, stamps.others, anew)
    period_s = stamps.period_s
    if ticks is not None and not (period_s > 0.0 or anew.all()):
        period_s = float(np.median(ticks[~anew])) * stamps.tick_s
    if ticks is not None:
        seconds = np.asarray(ticks * stamps.tick_s)
    else:
        assert samples is not None  # one of the two is there
        seconds = np.asarray(samples * period_s)
    samples = _unlike_stride(samples, counts, seconds[~anew], period_s, anew)
    missing, irregular = _missing(seconds, samples, period_s, span, anew)
    if counts is not None and samples is not None:
        counts = counts + np.round((missing + 1 - samples) / span).astype(np.int64) * span
    pauses = _pauses(stamps, anew, seconds)
    unknown = anew & np.isnan(pauses)
    seconds = np.where(anew, np.where(unknown, UNKNOWN_PAUSE_S, pauses), seconds)
    return _Steps(seconds, np.where(anew, 0, missing), anew, unknown, period_s, counts, irregular)


def _starts_anew(stamps: Stamps, counts: IntArray | None, ticks: IntArray | None) -> BoolArray:
    """Mark steps over which the sensor's clock, or else its counter, went back or was reset."""
    if ticks is not None:
        anew = (ticks > _TICK_SPAN // 2) | (ticks == 0)
        known = None if stamps.computer_s is None else np.isfinite(stamps.computer_s)
    else:
        assert counts is not None
        anew, known = counts > stamps.counter_span // 2, stamps.starts
    return anew if known is None else np.asarray(anew | known[1:])


def _samples(counts: IntArray | None, others: IntArray | None, anew: BoolArray) -> FloatArray | None:
    """Sampling periods of each step of the counter; a sensor may count several for each sample."""
    if counts is None:
        return None
    own = np.maximum(counts - (0 if others is None else np.diff(others)), 1)
    return np.maximum(own / _stride(own[~anew]), 1.0)


def _stride(steps: IntArray) -> int:
    """Greatest common divisor of all steps but rare ones, such as those where the counter wraps round."""
    if steps.size and steps.max() < _FEW:
        often = np.bincount(steps)  # a tenth of the time of `unique`
        values = np.flatnonzero(often)
        often = often[values]
    else:
        values, often = np.unique(steps, return_counts=True)
    return int(np.gcd.reduce(values[often >= _RARE * steps.size])) or 1


def _unlike_stride(
    samples: FloatArray | None, counts: IntArray | None, seconds: FloatArray, period_s: float, anew: BoolArray
) -> FloatArray | None:
    """Sampling periods of each step, corrected by the known period if, say, every other sample is lost."""
    if samples is None or counts is None or not period_s > 0.0 or not seconds.size:
        return samples
    times = float(np.median(seconds / (period_s * samples[~anew])))
    whole = round(times)
    divides = whole > 1 and not (counts[~anew] % whole).any()
    return samples * whole if divides and abs(times - whole) < 0.1 else samples


def _missing(
    seconds: FloatArray, samples: FloatArray | None, period_s: float, span: int, anew: BoolArray
) -> tuple[IntArray, bool]:
    """Number of missing samples in each step, and whether the clock is too irregular to tell all.

    By the counter; by the clock where the counter wrapped or there is none.
    """
    by_clock = seconds / period_s if period_s > 0.0 else np.ones(seconds.size)
    if samples is None:
        taken, irregular = _by_clock(np.where(anew, 1.0, by_clock))
    else:
        taken = samples + np.maximum(np.round((by_clock - samples) / span), 0) * span
        irregular = False
    return np.round(taken).astype(np.int64) - 1, irregular


def _by_clock(periods: FloatArray) -> tuple[FloatArray, bool]:
    """Whole periods of each step, and whether the clock is irregular.

    A clock with jitter has long steps without a loss, but short ones after them: then time is nearer to a
    straight line over the samples if the long steps count as one period.
    """
    counted = [np.where(periods > limit, np.round(periods), 1.0) for limit in (_LONGER, *_LONGER_STILL)]
    if np.array_equal(counted[0], counted[-1]):
        return counted[0], False
    time = np.concatenate(([0.0], np.cumsum(periods)))
    off = [_off_line(np.concatenate(([0.0], np.cumsum(each))), time) for each in counted]
    best = int(np.argmin(np.array(off) + 1e-6 * np.arange(len(off))))  # of equals the first
    return counted[best], not np.array_equal(counted[best], counted[0])


def _off_line(index: FloatArray, time: FloatArray) -> float:
    """RMS distance of times from a straight line over an index."""
    across, along = index - index.mean(), time - time.mean()
    slope = float(across @ along) / max(float(across @ across), 1e-300)
    return float(np.sqrt(np.mean((along - slope * across) ** 2)))


def _pauses(stamps: Stamps, anew: BoolArray, seconds: FloatArray) -> FloatArray:
    """Pause before each new start by the computer's clock, shape (m - 1,); NaN where that is not known."""
    pauses = np.full(anew.size, np.nan)
    if stamps.computer_s is None:
        return pauses
    running = np.concatenate(([0.0], np.cumsum(np.where(anew, 0.0, seconds))))
    behind = stamps.computer_s - running  # constant while the sensor runs, and larger by each pause
    told = np.flatnonzero(np.isfinite(behind))
    for before, after in pairwise(told):
        if anew[before:after].sum() == 1:
            pauses[after - 1] = behind[after] - behind[before]
    return np.where(pauses > 0.0, pauses, np.nan)


def _risen(stamps: Stamps, steps: _Steps) -> IntArray | None:
    if stamps.counter is None or steps.counts is None:
        return None
    return np.asarray(stamps.counter[0] + np.concatenate(([0], np.cumsum(steps.counts))))


def _gaps(steps: _Steps) -> tuple[Gap, ...]:
    long = (steps.seconds > _LONGER * steps.period_s) & (not steps.irregular)
    at = np.flatnonzero((steps.missing > 0) | steps.anew | long)
    return tuple(Gap(int(i), int(steps.missing[i]), float(steps.seconds[i])) for i in at)


def _notes(repeats: int, steps: _Steps) -> tuple[str, ...]:
    notes = []
    if repeats:
        notes.append(f"{repeats} samples came twice; the second was left out")
    if steps.irregular:
        shortest, longest = 1e3 * steps.seconds.min(), 1e3 * steps.seconds.max()
        notes.append(
            f"irregular clock, steps of {shortest:.3g} to {longest:.3g} ms: single losses cannot be told"
        )
    if steps.anew.any():
        told = int((steps.anew & ~steps.unknown).sum())
        notes.append(
            f"the sensor started anew {steps.anew.sum()} times; the pause is by the computer's clock "
            f"{told} times, else not known and taken as {UNKNOWN_PAUSE_S:g} s"
        )
    return tuple(notes)
