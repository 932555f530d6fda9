"""`orient`: orientation of a log from gyroscope, accelerometer and, for heading alone, magnetometer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.streams import TimedRotations
from xsens.fusion.increments import Samples
from xsens.fusion.readings import UNKNOWN_HEADING_RAD, usable_samples
from xsens.fusion.settings import BRIDGED_S, FusionSettings
from xsens.logs.samples import ImuLog

if TYPE_CHECKING:
    from xsens.fusion.smoothing import FilterSteps, Smoothed

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


class _Result(NamedTuple):
    """Orientation of one stretch, a row per sample; quaternions scalar last."""

    xyzw: FloatArray
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
    if not isinstance(log, ImuLog):
        raise InvalidInputError(f"expected an ImuLog, as read_log(path) gives, got {type(log).__name__}")
    settings = settings or FusionSettings()
    used, samples, notes = usable_samples(log)
    if settings.use_magnetometer and not np.isfinite(samples.field_au).all(axis=1).any():
        notes.append("no magnetometer: the heading is relative to the start")
        settings = replace(settings, use_magnetometer=False)
    breaks = np.flatnonzero(samples.step_s > BRIDGED_S)
    if breaks.size:
        notes.append(f"{breaks.size} pauses over {BRIDGED_S:g} s: orientation found anew after each")
    results = _stretches(samples, breaks, settings, smooth)
    joined = _Result(*map(np.concatenate, zip(*results, strict=True)))
    heading_sd = float(np.median(joined.sd_rad[:, 2]))
    if heading_sd > UNKNOWN_HEADING_RAD:
        notes.append(f"the heading is not known: standard deviation {np.rad2deg(heading_sd):.0f} degrees")
    rotations = TimedRotations(log.time_s[used], Rotation.from_quat(joined.xyzw))
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
    from xsens.fusion.smoothing import forward, fresh_filter, smooth, within_steps  # which loads numba

    results: list[_Result] = []
    kept = fresh_filter(settings)
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
            steps, found = smooth(stretch, settings)
            nodes, biases = found.matrices, found.bias_rad_s
            within = within_steps(steps, nodes[:-1], biases[:-1], nodes[1:])
            results.append(_from_smoother(steps, found, within))
        else:
            steps = forward(stretch, settings, kept, pause_s)
            results.append(_from_filter(steps, within_steps(steps, steps.start, steps.start_bias)))
    return results


def _from_filter(steps: FilterSteps, xyzw: FloatArray) -> _Result:
    return _each_sample(steps, xyzw, steps.sd_rad, steps.bias, steps.disturbed, steps.resting)


def _from_smoother(steps: FilterSteps, found: Smoothed, xyzw: FloatArray) -> _Result:
    return _each_sample(steps, xyzw, found.sd_rad[1:], found.bias_rad_s[1:], found.disturbed, found.resting)


def _each_sample(
    steps: FilterSteps,
    xyzw: FloatArray,
    sd_rad: FloatArray,
    bias_rad_s: FloatArray,
    disturbed: BoolArray,
    resting: BoolArray,
) -> _Result:
    """Give every sample what was found for its step."""
    each = np.repeat(np.arange(len(steps.last)), np.diff(steps.last, prepend=0))
    return _Result(xyzw, sd_rad[each], bias_rad_s[each], disturbed[each], resting[each])
