"""Check readings for wrong units and contradictions, and make those of a log usable for the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from xsens.logs.clocks import SHORTEST_S
from xsens.logs.contradictions import contradictions
from xsens.logs.faults import without_faults
from xsens.logs.samples import ImuLog, finite_rows, median, row_norms

BRIDGED_S = 0.1
"""The longest pause that is integrated over: a hand's rate changes little in it (tremor: below 12 Hz)."""

LOST = 1.5
"""A step longer than so many usual ones holds lost samples."""

BIAS_SD_RAD_S = np.deg2rad(1.0)
"""Standard deviation of a gyroscope's bias at switching on."""

PAUSE_S = 1.25 * BRIDGED_S
"""A longer step is a pause. Steps of a clock of 10 Hz vary by rounding, and by jitter."""


@dataclass(frozen=True)
class Samples:
    """Samples of one stretch without a pause.

    Attributes
    ----------
    step_s : ndarray, shape (m,)
        Time from the sample before to each sample; the first is a usual step.
    rate_rad_s, force_m_s2 : ndarray, shape (m, 3)
        Gyroscope and accelerometer, finite.
    field_au : ndarray, shape (m, 3)
        Magnetometer; rows may be NaN.
    lost_rad2 : ndarray, shape (m,)
        Variance of the turn about each axis over lost readings before each sample.
    """

    step_s: FloatArray
    rate_rad_s: FloatArray
    force_m_s2: FloatArray
    field_au: FloatArray
    lost_rad2: FloatArray

    def __len__(self) -> int:
        return int(self.step_s.size)

    def __getitem__(self, part: slice) -> Samples:
        return Samples(*(values[part] for values in vars(self).values()))


@dataclass(frozen=True)
class Estimate:
    """Orientation of one stretch, a row per sample.

    Attributes
    ----------
    xyzw : ndarray, shape (m, 4)
        World from sensor, scalar last.
    standard_deviation_rad, gyro_bias_rad_s, disturbed, resting, field_stray, field_iron
        As in `xsens.fusion.orient.Orientation`.
    """

    xyzw: FloatArray
    standard_deviation_rad: FloatArray
    gyro_bias_rad_s: FloatArray
    disturbed: BoolArray
    resting: BoolArray
    field_stray: FloatArray
    field_iron: FloatArray


def usable_samples(log: ImuLog) -> tuple[IntArray, Samples, list[str], float]:
    """Prepare a log's readings for the filter.

    Returns
    -------
    ndarray of int, shape (m,)
        Indices of the samples with a gyroscope reading.
    Samples
        Those samples, accelerometer readings interpolated where missing.
    list of str
        Notes on what was left out, interpolated or contradictory.
    float
        Share of its turns by which the gyroscope is off.

    Raises
    ------
    InsufficientDataError
        If gyroscope or accelerometer is missing, or has fewer than two readings.
    InvalidInputError
        If times, accelerometer or gyroscope are in other units.
    """
    source, before, log = log.source or "log", len(log.notes), without_faults(log)
    notes, rate, force = list(log.notes[before:]), log.gyroscope_rad_s, log.accelerometer_m_s2
    turns, pulls = (np.zeros(len(log), bool) if part is None else finite_rows(part) for part in (rate, force))
    rows = _near(log.time_s, turns) & _near(log.time_s, pulls)
    count = min((rows & turns).sum(), (rows & pulls).sum())
    if rate is None or force is None or count < 2:
        problems = ["no gyroscope"] * (rate is None) + ["no accelerometer"] * (force is None) or [str(count)]
        problems += [note for note in log.notes if note.startswith(("columns", "gyro", "accel"))]
        if log.oriented.any():
            problems.append("--method sensor takes the sensor's own orientation")
        raise InsufficientDataError(
            f"{source}: expected two samples of gyroscope and accelerometer, got {'; '.join(problems)}"
        )
    steps_s = np.diff(log.time_s)
    if (median_s := median(steps_s)) > 1.05 * BRIDGED_S or steps_s.mean() < SHORTEST_S:  # jitter at 10 Hz
        raise InvalidInputError(
            f"{source}: expected samples {SHORTEST_S:g} to {BRIDGED_S:g} s apart, got a median of "
            f"{median_s:.4g} s: times in milliseconds?"
        )
    against, scale_error = contradictions(log)
    fatal = ["accelerometer's axis", "gravity", "gyroscope", "accelerometer"]
    if against.get("accelerometer") != "":  # nor does it agree: either may be wrong
        fatal += ["own orientation", "magnetometer"]
    for name in fatal:
        if problem := against.get(name):
            advice = " --no-magnetometer leaves it out" if name == "magnetometer" else ""
            raise InvalidInputError(f"{source}: {problem}{advice}")
    notes += filter(None, against.values())
    field = log.magnetometer_au
    if against.get("magnetometer") or against.get("magnetometer's axis"):
        field = None
        notes.append("the magnetometer is left out")
    if left_out := (~rows).sum():
        notes.append(f"{left_out} samples without gyroscope or accelerometer left out")
    time_s, usual_s = log.time_s[rows], median(np.diff(log.time_s[rows]))
    step_s, lost_rad2 = np.diff(time_s, prepend=time_s[0] - usual_s), np.zeros_like(time_s)
    means = []
    for name, readings, valid in (
        ("gyroscope", rate[rows], turns[rows]),
        ("accelerometer", force[rows], pulls[rows]),
    ):
        if count := (~valid).sum():
            notes.append(f"{count} {name} readings missing: interpolated")
        means.append(_interpolated_means(time_s, step_s, usual_s, readings, valid))
    valid = turns[rows]
    lost_rad2[np.flatnonzero(valid)[1:]] = lost_variance(time_s[valid], rate[rows & turns], usual_s)
    field = np.full_like(means[0], np.nan) if field is None else field[rows]
    return np.flatnonzero(rows), Samples(step_s, means[0], means[1], field, lost_rad2), notes, scale_error


def lost_variance(time_s: FloatArray, rate_rad_s: FloatArray, usual_s: float) -> FloatArray:
    """Variance of the turn about each axis from each sample to the next, where those between were lost.

    Its shape is (m - 1,). The rate may change as much as it did from the sample before to the one after.
    """
    step_s = np.diff(time_s)
    gap = np.flatnonzero((step_s > LOST * usual_s) & (step_s <= PAUSE_S))
    variance = np.zeros_like(step_s)
    variance[gap] = (step_s[gap] * row_norms(rate_rad_s[gap + 1] - rate_rad_s[gap])) ** 2
    return variance


def _interpolated_means(
    time_s: FloatArray, step_s: FloatArray, usual_s: float, readings: FloatArray, valid: BoolArray
) -> FloatArray:
    """Mean reading since the sample before, shape (m, 3), where samples between the two were lost.

    A reading tells the last usual step alone; before that it is taken for the mean of the two.
    """
    if not valid.all():
        readings = np.column_stack([np.interp(time_s, time_s[valid], axis[valid]) for axis in readings.T])
    late, means = np.flatnonzero((step_s > LOST * usual_s) & (step_s <= PAUSE_S)), readings.copy()
    share = (usual_s / step_s[late])[:, None]
    means[late] = 0.5 * ((1.0 + share) * readings[late] + (1.0 - share) * readings[late - 1])
    return means


def _near(time_s: FloatArray, valid: BoolArray) -> BoolArray:
    """Where a reading is valid, or one before and one after it at most a bridged pause apart."""
    valid_s, before = np.concatenate([[-np.inf], time_s[valid], [np.inf]]), np.cumsum(valid)
    return np.asarray(valid_s[before + ~valid] - valid_s[before] <= PAUSE_S)
