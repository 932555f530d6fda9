"""Orientation of a log from its gyroscope, its accelerometer and, for heading alone, its magnetometer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedRotations
from xsens.fusion.errorstate import ErrorStateFilter
from xsens.fusion.forward import Pass, forward, within_steps
from xsens.fusion.increments import Samples
from xsens.fusion.plausible import (
    UNKNOWN_HEADING_RAD,
    contradiction,
    real_field,
    require_metres,
    require_radians,
    require_rising_in_seconds,
)
from xsens.fusion.settings import BRIDGED_S, FusionSettings
from xsens.fusion.smoothing import Smoothed, smooth
from xsens.logs.samples import ImuLog

_SHORTEST_S = 3.0
"""Shorter stretches are filtered, not smoothed: they hold little more than the filter's start."""


@dataclass(frozen=True)
class Orientation:
    """Orientation of every sample that has a gyroscope reading.

    Attributes
    ----------
    rotations : TimedRotations
        World from sensor; x magnetic north, y west, z up. Without a magnetometer x is where it was at the
        start.
    standard_deviation_rad : ndarray, shape (m, 3)
        About the world's axes: two of inclination, one of heading.
    gyro_bias_rad_s : ndarray, shape (m, 3)
    disturbed : ndarray of bool, shape (m,)
        Where the magnetic field was not trusted.
    resting : ndarray of bool, shape (m,)
    smoothed : bool
    notes : tuple of str
        What was missing or bridged.
    magnetic : bool
        Whether the heading is by the magnetic field; else it is relative to the start.
    """

    rotations: TimedRotations
    standard_deviation_rad: FloatArray
    gyro_bias_rad_s: FloatArray
    disturbed: BoolArray
    resting: BoolArray
    smoothed: bool
    notes: tuple[str, ...] = ()
    magnetic: bool = True

    def __len__(self) -> int:
        return len(self.rotations)


@dataclass(frozen=True)
class _Result:
    """Of one stretch, per sample; quaternions scalar first."""

    wxyz: FloatArray
    sd_rad: FloatArray
    bias_rad_s: FloatArray
    disturbed: BoolArray
    resting: BoolArray


def orient(log: ImuLog, settings: FusionSettings | None = None, smooth: bool = True) -> Orientation:
    """Estimate the orientation of a log.

    Parameters
    ----------
    log : ImuLog
        With gyroscope and accelerometer. Without a magnetometer, the heading is relative to the start.
    settings : FusionSettings, optional
    smooth : bool
        Use what comes after each sample as well as what comes before; without, as a live filter would.

    Raises
    ------
    InsufficientDataError
        If the log lacks a gyroscope or an accelerometer, or has fewer than two samples of them.
    InvalidInputError
        If the times cannot be in s, the accelerometer in m/s^2 or the gyroscope in rad/s.

    Notes
    -----
    After a pause of more than 0.1 s nothing is known of how the sensor turned: up and north are found
    again, the bias and the field's reference are kept.
    """
    _require_log(log)
    settings = settings or FusionSettings()
    used, samples, notes = _usable(log)
    if settings.use_magnetometer and not np.isfinite(samples.field_au).all(axis=1).any():
        notes.append("no magnetometer: the heading is relative to the start")
        settings = replace(settings, use_magnetometer=False)
    breaks = np.flatnonzero(samples.step_s > BRIDGED_S)
    if breaks.size:
        notes.append(f"{breaks.size} pauses over {BRIDGED_S:g} s: orientation found anew after each")
    results = _stretches(samples, breaks, settings, smooth)
    joined = _Result(*(np.concatenate(parts) for parts in zip(*map(_fields, results), strict=True)))
    heading_sd = float(np.median(joined.sd_rad[:, 2]))
    if heading_sd > UNKNOWN_HEADING_RAD:
        notes.append(f"the heading is not known: standard deviation {np.rad2deg(heading_sd):.0f} degrees")
    rotations = TimedRotations(log.time_s[used], Rotation.from_quat(joined.wxyz, scalar_first=True))
    return Orientation(
        rotations,
        joined.sd_rad,
        joined.bias_rad_s,
        joined.disturbed,
        joined.resting,
        smooth,
        tuple(notes),
        settings.use_magnetometer,
    )


# -- samples


def _require_log(log: object) -> None:
    """A path is a mistake soon made."""
    if not isinstance(log, ImuLog):
        raise InvalidInputError(f"expected an ImuLog, as read_log(path) gives, got {type(log).__name__}")


def _usable(log: ImuLog) -> tuple[IntArray, Samples, list[str]]:
    """Indices of samples with a gyroscope reading, the samples, and what had to be done to them."""
    source = log.source or "log"
    if log.gyroscope_rad_s is None or log.accelerometer_m_s2 is None:
        lacking = {"gyroscope": log.gyroscope_rad_s, "accelerometer": log.accelerometer_m_s2}
        none = " and ".join(f"no {name}" for name, values in lacking.items() if values is None)
        why = "".join(f"; {note}" for note in log.notes if note.startswith("columns not understood"))
        raise InsufficientDataError(f"{source}: expected gyroscope and accelerometer, got {none}{why}")
    used = np.flatnonzero(np.isfinite(log.gyroscope_rad_s).all(axis=1))
    force = log.accelerometer_m_s2[used]
    there = np.isfinite(force).all(axis=1)
    if used.size < 2 or there.sum() < 2:
        raise InsufficientDataError(
            f"{source}: expected two samples of gyroscope and accelerometer or more, got {int(there.sum())}"
        )
    time_s, notes = log.time_s[used], []
    steps = np.diff(time_s)
    require_rising_in_seconds(steps, source)
    require_metres(force[there], source)
    require_radians(log.gyroscope_rad_s[used], source)
    if used.size < len(log):
        notes.append(f"{len(log) - used.size} samples without gyroscope left out")
    if not there.all():
        notes.append(f"{int((~there).sum())} accelerometer readings missing: interpolated")
        force = np.column_stack([np.interp(time_s, time_s[there], column[there]) for column in force.T])
    field = np.full((used.size, 3), np.nan)
    if log.magnetometer_au is not None:
        field, zeros = real_field(log.magnetometer_au[used])
        if zeros:
            notes.append(f"magnetometer reads zero in {zeros} of {used.size} samples: left out")
    against = contradiction(time_s, log.gyroscope_rad_s[used], force)
    if against is not None:
        notes.append(against)
    step_s = np.concatenate([[np.median(steps)], steps])
    return used, Samples(step_s, log.gyroscope_rad_s[used], force, field), notes


# -- stretches


def _stretches(
    samples: Samples, breaks: IntArray, settings: FusionSettings, smoothing: bool
) -> list[_Result]:
    results: list[_Result] = []
    kalman: ErrorStateFilter | None = None
    step_s = float(np.median(samples.step_s))
    edges = [0, *breaks.tolist(), len(samples)]
    for first, last in pairwise(edges):
        if first == last:
            continue
        stretch = samples[first:last]
        pause_s = float(stretch.step_s[0])
        if first:
            stretch = replace(stretch, step_s=np.concatenate([[step_s], stretch.step_s[1:]]))
        if smoothing and stretch.step_s.sum() > _SHORTEST_S:
            results.append(_from_smoother(*smooth(stretch, settings)))
            continue
        done, kalman = forward(stretch, settings, kalman, pause_s)
        results.append(_from_filter(done))
    return results


def _from_filter(done: Pass) -> _Result:
    steps = done.steps
    starts = Rotation.from_matrix([step.start for step in steps]).as_quat(scalar_first=True)
    resting = np.array([step.resting for step in steps])
    biases = np.array([step.start_bias_rad_s for step in steps])
    wxyz = within_steps(done, starts, biases, resting)
    sd = np.sqrt([np.diag(step.covariance)[:3] for step in steps])
    disturbed = np.array([step.disturbed for step in steps])
    after = np.array([step.bias_rad_s for step in steps])
    return _per_sample(done, wxyz, sd, after, disturbed, resting)


def _from_smoother(done: Pass, found: Smoothed) -> _Result:
    """Within a step by the gyroscope, with what it misses at the step's end spread over the step."""
    nodes = Rotation.from_matrix(found.matrices)
    wxyz = within_steps(done, nodes[:-1].as_quat(scalar_first=True), found.bias_rad_s[:-1], found.resting)
    ends = Rotation.from_quat([q[-1] for q in wxyz], scalar_first=True)
    missed = (nodes[1:] * ends.inv()).as_rotvec()
    spread = []
    for k, q in enumerate(wxyz):
        share = done.time_s[k] / done.time_s[k][-1]
        correction = Rotation.from_rotvec(share[:, None] * missed[k])
        spread.append((correction * Rotation.from_quat(q, scalar_first=True)).as_quat(scalar_first=True))
    return _per_sample(done, spread, found.sd_rad[1:], found.bias_rad_s[1:], found.disturbed, found.resting)


def _per_sample(
    done: Pass,
    wxyz: list[FloatArray],
    sd_rad: FloatArray,
    bias_rad_s: FloatArray,
    disturbed: BoolArray,
    resting: BoolArray,
) -> _Result:
    counts = [len(times) for times in done.time_s]
    each = np.repeat(np.arange(len(counts)), counts)
    return _Result(np.concatenate(wxyz), sd_rad[each], bias_rad_s[each], disturbed[each], resting[each])


def _fields(result: _Result) -> tuple[npt.NDArray[Any], ...]:
    return result.wxyz, result.sd_rad, result.bias_rad_s, result.disturbed, result.resting
