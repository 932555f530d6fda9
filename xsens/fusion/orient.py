"""`orient`: orientation of a log from gyroscope, accelerometer and, for heading alone, magnetometer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.streams import TimedRotations
from xsens.fusion.errorstate import ErrorStateFilter
from xsens.fusion.increments import Samples, quaternion_product, quaternions_of
from xsens.fusion.readings import UNKNOWN_HEADING_RAD, require_log, usable_samples
from xsens.fusion.settings import BRIDGED_S, FusionSettings
from xsens.fusion.smoothing import Pass, Smoothed, forward, smooth
from xsens.logs.samples import ImuLog

_SHORTEST_S = 3.0
"""Shorter stretches are filtered, not smoothed: most of their time is the filter's start."""


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
        What was missing or interpolated.
    magnetic : bool
        True if the heading is by the magnetic field, false if it is relative to the start.
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
    """Orientation of one stretch, a row per sample; quaternions scalar first."""

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
        Use the readings after each sample as well as those before; without, as a live filter would.

    Raises
    ------
    InsufficientDataError
        If the log lacks a gyroscope or an accelerometer, or has fewer than two samples of them.
    InvalidInputError
        If the times cannot be in s, the accelerometer in m/s^2 or the gyroscope in rad/s.

    Notes
    -----
    How the sensor turned in a pause of more than 0.1 s is not known: up and north are found again after it;
    the bias and the field's reference are kept.

    Examples
    --------
    A sensor at rest, its x axis to magnetic north:

    >>> import numpy as np
    >>> from xsens import ImuLog, orient
    >>> time_s = np.arange(500) / 100.0
    >>> up, still, field = (np.tile(v, (500, 1)) for v in ([0, 0, 9.81], [0, 0, 0.0], [0.4, 0, -0.9]))
    >>> found = orient(ImuLog(time_s, up, still, field))
    >>> bool(found.rotations.world_from_sensor.magnitude().max() < 1e-6)
    True
    """
    require_log(log)
    settings = settings or FusionSettings()
    used, samples, notes = usable_samples(log)
    if settings.use_magnetometer and not np.isfinite(samples.field_au).all(axis=1).any():
        notes.append("no magnetometer: the heading is relative to the start")
        settings = replace(settings, use_magnetometer=False)
    breaks = np.flatnonzero(samples.step_s > BRIDGED_S)
    if breaks.size:
        notes.append(f"{breaks.size} pauses over {BRIDGED_S:g} s: orientation found anew after each")
    results = _stretches(samples, breaks, settings, smooth)
    joined = _Result(
        *(np.concatenate(parts) for parts in zip(*(vars(each).values() for each in results), strict=True))
    )
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
    wxyz = _within_steps(done, starts, biases, resting)
    sd = np.sqrt([np.diag(step.covariance)[:3] for step in steps])
    disturbed = np.array([step.disturbed for step in steps])
    after = np.array([step.bias_rad_s for step in steps])
    return _per_sample(done, wxyz, sd, after, disturbed, resting)


def _from_smoother(done: Pass, found: Smoothed) -> _Result:
    """Result by the gyroscope within each step; its error at the step's end is spread over the step."""
    nodes = Rotation.from_matrix(found.matrices)
    wxyz = _within_steps(done, nodes[:-1].as_quat(scalar_first=True), found.bias_rad_s[:-1], found.resting)
    ends = Rotation.from_quat([q[-1] for q in wxyz], scalar_first=True)
    missed = (nodes[1:] * ends.inv()).as_rotvec()
    spread = []
    for k, q in enumerate(wxyz):
        share = done.time_s[k] / done.time_s[k][-1]
        correction = Rotation.from_rotvec(share[:, None] * missed[k])
        spread.append((correction * Rotation.from_quat(q, scalar_first=True)).as_quat(scalar_first=True))
    return _per_sample(done, spread, found.sd_rad[1:], found.bias_rad_s[1:], found.disturbed, found.resting)


def _within_steps(
    done: Pass, starts: FloatArray, biases_rad_s: FloatArray, resting: BoolArray
) -> list[FloatArray]:
    """Orientation of every sample as quaternions, shape (samples, 4) per step, from the steps' starts.

    Parameters
    ----------
    done : Pass
    starts : ndarray, shape (steps, 4)
        World from sensor, scalar first.
    biases_rad_s : ndarray, shape (steps, 3)
    resting : ndarray of bool, shape (steps,)
        Steps in which the orientation is held.
    """
    out = []
    for k, step in enumerate(done.steps):
        if resting[k]:
            out.append(np.tile(starts[k], (len(done.turns[k]), 1)))
            continue
        off = step.increment.bias_rad_s - biases_rad_s[k]
        turns = quaternion_product(done.turns[k], quaternions_of(off * done.time_s[k][:, None]))
        out.append(quaternion_product(starts[k], turns))
    return out


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
