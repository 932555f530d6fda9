"""Check readings for wrong units and contradictions, and make those of a log usable for the filter."""

from __future__ import annotations

import math

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from xsens.fusion.samples import Samples
from xsens.fusion.settings import BRIDGED_S, LOST
from xsens.logs.samples import ImuLog

FORCE_M_S2 = (4.0, 25.0)
"""Limits of the median of the accelerometer's norm if it is in m/s^2."""

PAUSE_S = 1.25 * BRIDGED_S
"""A longer step is a pause. Steps of a clock of 10 Hz vary by rounding, and by jitter."""

FASTEST_RAD_S = 60.0
"""The widest range of the sensors' gyroscopes ends at 35 rad/s about an axis, and a hand's ordinary movement
in deg/s exceeds 60."""

UNKNOWN_HEADING_RAD = math.radians(45.0)
"""A heading with a larger standard deviation is unknown."""

_COMPARED_S = 0.1
"""Interval over which gravity's direction is compared: a hand turns by less than a radian in it."""

_TURNING_RAD_S = 0.2
"""Smallest RMS rate across gravity that is compared: eleven degrees per second, beyond any bias."""

_FOLLOWED = 0.3
"""Smallest fraction of the gyroscope's turn that gravity must show: it shows 1 if the unit is rad/s, 1/57 if
it is deg/s, 0 if the two do not belong together."""

_FEW = 0.01
"""Share of readings that may be errors of transmission."""

_FORCE_ENDS_M_S2 = 2000.0
_FIELD_ENDS_AU = (1e-12, 1e12)
"""Readings beyond them are none: accelerometers end at 200 g, fields in any unit are between."""

_NEAR_REST_M_S2 = 1.0
_FEWEST = 20


def usable_samples(log: ImuLog) -> tuple[IntArray, Samples, list[str]]:
    """Prepare a log's readings for the filter.

    Returns
    -------
    ndarray of int, shape (m,)
        Indices of the samples with a gyroscope reading.
    Samples
        Those samples, accelerometer readings interpolated where missing.
    list of str
        Notes on what was left out, interpolated or contradictory.

    Raises
    ------
    InsufficientDataError
        If gyroscope or accelerometer is missing, or has fewer than two readings.
    InvalidInputError
        If times, accelerometer or gyroscope are in other units.
    """
    source = log.source or "log"
    if log.gyroscope_rad_s is None or log.accelerometer_m_s2 is None:
        raise InsufficientDataError(f"{source}: expected gyroscope and accelerometer, got {_lacking(log)}")
    readable, wild = _readable(log.gyroscope_rad_s)
    readable &= _near(log.time_s, real_force(log.accelerometer_m_s2))
    used = np.flatnonzero(readable)
    part = slice(None) if used.size == len(log) else used
    rate, force = (_plain(values[part]) for values in (log.gyroscope_rad_s, log.accelerometer_m_s2))
    there = real_force(force)
    if used.size < 2 or there.sum() < 2:
        raise InsufficientDataError(
            f"{source}: expected two samples of gyroscope and accelerometer or more, got {int(there.sum())}"
        )
    time_s, notes = log.time_s[part], []
    steps = np.diff(time_s)
    _require_seconds(steps, source)
    require_metres(force if there.all() else force[there], source)
    _require_radians(rate, source)
    if used.size + wild < len(log):
        notes.append(f"{len(log) - used.size - wild} samples without gyroscope or accelerometer left out")
    if wild:
        notes.append(f"{wild} samples whose gyroscope reads over {FASTEST_RAD_S:g} rad/s left out")
    if not there.all():
        notes.append(f"{int((~there).sum())} accelerometer readings missing: interpolated")
        force = np.column_stack([np.interp(time_s, time_s[there], column[there]) for column in force.T])
    field = np.full((used.size, 3), np.nan)
    if log.magnetometer_au is not None:
        field, zeros = real_field(_plain(log.magnetometer_au[part]))
        if zeros:
            notes.append(f"magnetometer reads zero in {zeros} of {used.size} samples: left out")
    against = _contradiction(time_s, rate, force)
    if against is not None:
        notes.append(against)
    step_s = np.concatenate([[np.median(steps)], steps])
    return used, Samples(step_s, _bridging(rate, step_s), _bridging(force, step_s), field), notes


def _bridging(readings: FloatArray, step_s: FloatArray) -> FloatArray:
    """Mean reading since the sample before, shape (m, 3), where samples between the two were lost.

    A reading tells the last usual step alone; before that it is taken for the mean of the two.
    """
    usual = float(np.median(step_s))
    late = np.flatnonzero((step_s > LOST * usual) & (step_s <= PAUSE_S))
    if not late.size:
        return readings
    told = (usual / step_s[late])[:, None]
    means = readings.copy()
    means[late] = 0.5 * ((1.0 + told) * readings[late] + (1.0 - told) * readings[late - 1])
    return means


def _plain(values: FloatArray) -> FloatArray:
    """Values as kernels are compiled for, without a copy if they are so."""
    return np.require(values, dtype=float, requirements=["C", "W"])


def _lacking(log: ImuLog) -> str:
    """Names of the missing sensors, and the note on columns that may have been meant for them."""
    vectors = {"gyroscope": log.gyroscope_rad_s, "accelerometer": log.accelerometer_m_s2}
    none = " and ".join(f"no {name}" for name, values in vectors.items() if values is None)
    return none + "".join(f"; {note}" for note in log.notes if note.startswith("columns not understood"))


def _require_seconds(steps_s: FloatArray, source: str) -> None:
    """Raise `InvalidInputError` if samples are too far apart to integrate a gyroscope."""
    median = float(np.median(steps_s))
    if median > 1.05 * BRIDGED_S:  # a clock of 10 Hz, and jitter
        raise InvalidInputError(
            f"{source}: expected samples at most {BRIDGED_S:g} s apart, got a median of {median:.4g} s: "
            "times in milliseconds?"
        )


def require_metres(force_m_s2: FloatArray, source: str) -> None:
    """Raise `InvalidInputError` if an accelerometer, shape (m, 3), is not in m/s^2."""
    median = float(np.median(np.linalg.norm(force_m_s2, axis=1)))
    low, high = FORCE_M_S2
    if not low < median < high:
        raise InvalidInputError(
            f"{source}: expected an accelerometer in m/s^2, with norm near 9.8, got a median of {median:.3g}"
        )


def _require_radians(rate_rad_s: FloatArray, source: str) -> None:
    """Raise `InvalidInputError` if a hundredth of a gyroscope's readings, shape (m, 3), exceeds any range."""
    fast = float(np.percentile(np.linalg.norm(rate_rad_s, axis=1), 99.0))
    if fast > FASTEST_RAD_S:
        raise InvalidInputError(
            f"{source}: expected a gyroscope in rad/s, got one in a hundred over {fast:.3g}: in deg/s?"
        )


def _readable(rate_rad_s: FloatArray) -> tuple[BoolArray, int]:
    """Where a gyroscope, shape (m, 3), was read; and how many readings, a few, no gyroscope can give."""
    there = np.asarray(np.isfinite(rate_rad_s).all(axis=1))
    wild = there & (np.abs(rate_rad_s).max(axis=1) > FASTEST_RAD_S)
    if wild.sum() > _FEW * there.sum():
        return there, 0  # another unit, not errors
    return np.asarray(there & ~wild), int(wild.sum())


def _near(time_s: FloatArray, there: BoolArray) -> BoolArray:
    """Where a reading is there, or one before and one after it at most a bridged pause apart."""
    known = time_s[there]
    if not known.size:
        return np.ones(len(there), dtype=bool)
    after = np.clip(np.searchsorted(known, time_s), 0, known.size - 1)
    before = np.maximum(np.searchsorted(known, time_s, side="right") - 1, 0)
    return np.asarray(np.maximum(known[after], time_s) - np.minimum(known[before], time_s) <= PAUSE_S)


def real_force(force_m_s2: FloatArray) -> BoolArray:
    """Where an accelerometer, shape (m, 3), was read."""
    return np.asarray((np.abs(force_m_s2) < _FORCE_ENDS_M_S2).all(axis=1))


def real_field(field_au: FloatArray) -> tuple[FloatArray, int]:
    """The field, shape (m, 3), NaN where zero or beyond any unit, and how many readings were exactly zero."""
    zero = (field_au == 0.0).all(axis=1)
    low, high = _FIELD_ENDS_AU
    size = np.abs(field_au).max(axis=1, initial=0.0)
    none = ~((size > low) & (size < high))
    return np.where(none[:, None], np.nan, field_au) if none.any() else field_au, int(zero.sum())


def _contradiction(time_s: FloatArray, rate_rad_s: FloatArray, force_m_s2: FloatArray) -> str | None:
    """Note if gravity does not turn as the gyroscope reads; None if it does or nothing can be told.

    Seen from the sensor, gravity's direction u changes at the rate u x w. The RMS of both sides is compared,
    over short means near rest only. Movement makes the accelerometer show more turning, never less, except
    that of a free pendulum.
    """
    width = max(1, round(_COMPARED_S / float(np.median(np.diff(time_s)))))
    count = len(time_s) // width
    if count <= _FEWEST:
        return None
    rate, force = (a[: count * width].reshape(count, width, 3).mean(axis=1) for a in (rate_rad_s, force_m_s2))
    middle = time_s[: count * width].reshape(count, width).mean(axis=1)
    norm = np.linalg.norm(force, axis=1)
    up = force / np.maximum(norm, 1e-9)[:, None]
    step = np.diff(middle)
    calm = np.abs(norm - np.median(norm)) < _NEAR_REST_M_S2
    calm = calm[1:] & calm[:-1] & (step < 2.0 * np.median(step))
    if calm.sum() < _FEWEST:
        return None
    across = np.cross(up[1:] + up[:-1], rate[1:] + rate[:-1])[calm] / 4.0
    shown = np.diff(up, axis=0)[calm] / step[calm, None]
    square = float(np.mean((across**2).sum(axis=1)))
    share = math.sqrt(float(np.mean((shown**2).sum(axis=1))) / max(square, 1e-12))
    if square < _TURNING_RAD_S**2 or share > _FOLLOWED:
        return None
    return (
        f"gyroscope and accelerometer contradict each other: across gravity the one turns by "
        f"{math.sqrt(square):.2g} rad/s, the other shows {100.0 * share:.0f} % of it: gyroscope in rad/s?"
    )
