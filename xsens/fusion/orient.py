"""`orient`: orientation of a log from gyroscope, accelerometer and, for heading alone, magnetometer."""

from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.streams import TimedRotations
from speckle3d.core.text import shown
from xsens.fusion.readings import BIAS_SD_RAD_S, PAUSE_S, Estimate, Samples, usable_samples
from xsens.logs.samples import ImuLog, finite_rows

_FORESEEN = 3
"""Standard deviations of the gyroscope's bias that are foreseen; a larger one widens them."""

_SHORTEST_S = 3.0
"""Shorter stretches are filtered, not smoothed: most of their time is the filter's start."""


class Method(StrEnum):
    """Engine of an orientation; `smoother` and `vqf` use the readings after each sample as well."""

    smoother = "smoother"
    filter = "filter"
    vqf = "vqf"
    vqf_online = "vqf-online"

    @property
    def offline(self) -> bool:
        """Whether readings after a sample tell of its orientation."""
        return self in (Method.smoother, Method.vqf)


@shown
@dataclass(frozen=True)
class Orientation:
    """Orientation of every sample that has a gyroscope reading, or lies in a hole of at most 0.125 s.

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
    method : Method
        The engine that found it.
    notes : tuple of str
        What was missing or interpolated.
    magnetic : bool
        True if the heading is by the magnetic field, false if it is relative to the start.
    field_stray : ndarray, shape (m,)
        How much the field changes from place to place, as this package's filter has it: a fraction of its
        norm, per component. NaN where no field tells the heading.
    field_iron : ndarray, shape (m,)
        Likelihood that iron is on the sensor, 0 to 1, and NaN likewise. A sensor that is turned while it is
        carried through an uneven field shows nearly the same.
    """

    rotations: TimedRotations
    standard_deviation_rad: FloatArray
    gyro_bias_rad_s: FloatArray
    disturbed: BoolArray
    resting: BoolArray
    method: Method
    notes: tuple[str, ...]
    magnetic: bool
    field_stray: FloatArray
    field_iron: FloatArray

    def __len__(self) -> int:
        return len(self.rotations)


def orient(log: ImuLog, magnetometer: bool = True, method: Method | str = Method.smoother) -> Orientation:
    """Estimate the orientation of a log.

    Parameters
    ----------
    log : ImuLog
        With gyroscope and accelerometer.
    magnetometer : bool
        Let it tell the heading; without it, the heading is relative to the start.
    method : Method or str
        smoother, or vqf: use the readings after each sample as well as those before; filter, or vqf-online:
        as live.

    Returns
    -------
    Orientation
        Of every sample that has a gyroscope reading, or lies in a hole of at most 0.125 s.

    Raises
    ------
    InsufficientDataError
        If the log lacks a gyroscope or an accelerometer, or has fewer than two samples of them.
    InvalidInputError
        If the times cannot be in s, the accelerometer in m/s^2 or the gyroscope in rad/s, or if VQF is asked
        for and not installed.
    ValueError
        If there is no such method.

    Notes
    -----
    How the sensor turned in a pause of more than 0.125 s is not known: up and north are found again after it.
    The filter keeps the bias, the field of iron on the sensor and the magnetometer's lag; VQF nothing. In a
    shorter hole the readings are taken for the mean of those around it.

    VQF claims no errors of the orientation. So its variance about each of the world's axes is that of the
    smoother beside off-line VQF, or of the filter beside on-line VQF, plus the squared distance between the
    two orientations. Bias, rest and disturbance are VQF's own; it takes a field that it has not yet come to
    know for disturbed.

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
    method, used = Method(method), log if magnetometer else replace(log, magnetometer_au=None)
    rows, samples, notes, scale_error = usable_samples(used)
    magnetic = bool(finite_rows(samples.field_au).any())
    if magnetometer and not magnetic:
        notes.append("no magnetometer: the heading is relative to the start")
    breaks = np.flatnonzero(samples.step_s > PAUSE_S)
    if breaks.size:
        notes.append(f"{breaks.size} pauses over {PAUSE_S:g} s: orientation found anew after each")
    estimate = _estimate(samples, breaks, method, magnetic, scale_error)
    bias = np.abs(estimate.gyro_bias_rad_s).max()
    if bias > _FORESEEN * BIAS_SD_RAD_S:
        notes.append(f"a gyroscope bias of {np.rad2deg(bias):.1f} deg/s: found again, foreseen so large")
        estimate = _estimate(samples, breaks, method, magnetic, scale_error, bias)
    columns = vars(estimate).copy()
    rotations = TimedRotations(log.time_s[rows], Rotation.from_quat(columns.pop("xyzw")))
    return Orientation(rotations, **columns, method=method, notes=tuple(notes), magnetic=magnetic)


def _estimate(
    samples: Samples, breaks: IntArray, method: Method, magnetic: bool, *gyroscope: Any
) -> Estimate:
    """Each stretch by the method asked for, or by its on-line twin if it is short.

    `gyroscope` is what `xsens.fusion.engines.Filter` takes for granted of it.
    """
    from xsens.fusion.engines import Filter, by_vqf, smooth  # which loads numba

    estimates: list[Estimate] = []
    online = Filter(magnetic, *gyroscope)
    step_s = np.median(samples.step_s)
    for first, last in pairwise([0, *breaks.tolist(), len(samples)]):
        stretch = samples[first:last]
        if first:
            online.begin(stretch.step_s[0])
            stretch = replace(stretch, step_s=np.append(step_s, stretch.step_s[1:]))
        offline = method.offline and stretch.step_s.sum() > _SHORTEST_S
        estimate = (
            smooth(stretch, Filter(magnetic, *gyroscope)) if offline else online.run(stretch, to_end=True)
        )
        estimates.append(by_vqf(stretch, estimate, offline, magnetic) if "vqf" in method else estimate)
    columns = zip(*(vars(estimate).values() for estimate in estimates), strict=True)
    return Estimate(*map(np.concatenate, columns))
