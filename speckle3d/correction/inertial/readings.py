"""Raw readings of an inertial sensor, turned into the image's axes and their noise measured."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from speckle3d.core.arrays import BoolArray, FloatArray
from speckle3d.core.errors import InsufficientDataError, InvalidInputError, MismatchError
from speckle3d.core.sweep import OrientationSensor
from speckle3d.correction.inertial.problem import GRAVITY_M_S2, Readings

_SMOOTH_S = 0.15
"""Standard deviation of the Gaussian that leaves of the orientation readings what is slower than a wobble."""
_NODE_S = 0.05
_TREMOR_HZ = 12.0
"""Hands do not tremble faster; above, readings are noise."""
LEAST_HZ = 40.0
"""Fewer readings a second do not follow a tremor of 12 Hz: 3.3 in a period."""
_HELD = 3
"""Readings in a row at the same extreme value that show a sensor's range."""
_RANGE_STEPS = 50
"""How many quantization steps an extreme lies off the median when it is a range and not a coarse scale."""
_GRAVITY_SHARE = 0.03
"""Gravity on earth is 9.78 to 9.83 m/s^2, and a bias of 0.2 m/s^2 is another 2 %."""
_MARGIN_S = 0.25
"""Readings this long before and after the frames are used, too."""


def inertial_readings(sensor: OrientationSensor, frame_time_s: FloatArray) -> Readings:
    """Turn a sensor's raw readings around the frames into the image's axes.

    Raises
    ------
    InsufficientDataError
        If gyroscope, accelerometer or mounting are missing, readings are too few or saturated.
    MismatchError
        If the accelerometer does not feel gravity as 9.8 m/s^2.
    """
    force, rate, mounting = sensor.accelerometer_m_s2, sensor.gyroscope_rad_s, sensor.sensor_from_image
    if mounting is None:
        raise InsufficientDataError(f"inertial scale: {sensor.uncalibrated}")
    for values, name in ((force, "accelerometer_m_s2"), (rate, "gyroscope_rad_s")):
        if values is None:
            raise InsufficientDataError(
                f"inertial scale: expected {name} of the sensor, got none; record raw readings, too"
            )
        if not np.isfinite(values).all():
            raise InvalidInputError(f"inertial scale: {name}: expected finite values, got some that are not")
    assert force is not None
    assert rate is not None
    time_s = sensor.readings.time_s + sensor.time_offset_s
    some = (time_s >= frame_time_s[0] - _MARGIN_S) & (time_s <= frame_time_s[-1] + _MARGIN_S)
    _require_sampling(time_s[some], frame_time_s, sensor.readings.max_gap_s)
    _require_unsaturated(force[some], "accelerometer", "m/s^2")
    _require_unsaturated(rate[some], "gyroscope", "rad/s")
    _require_gravity(force[some])
    time_s, turned = time_s[some], sensor.readings.world_from_sensor[some] * mounting
    image_from_sensor = mounting.inv()
    felt = image_from_sensor.apply(force[some])
    spun = image_from_sensor.apply(rate[some])
    steps = (turned[:-1].inv() * turned[1:]).as_rotvec()
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    up = turned.inv().apply([0.0, 0.0, 1.0])
    hz = 1.0 / float(np.median(np.diff(time_s)))
    node_s = np.append(np.arange(time_s[0], time_s[-1], _NODE_S), time_s[-1])
    smoothed = np.column_stack([_smoothed(time_s, column, hz, node_s) for column in [*angle.T, *up.T]])
    spline = make_interp_spline(node_s, smoothed, k=5)
    slow = spline(time_s)
    return Readings(
        time_s=time_s,
        force_m_s2=felt[:, 2],
        rate_rad_s=spun[:, :2],
        up=slow[:, 3:],
        turn_rate_rad_s=spline(time_s, 1)[:, :3],
        turn_rad_s2=spline(time_s, 2)[:, :3],
        force_sigma=_white(felt[:, 2], hz),
        rate_sigma=float(np.sqrt(np.mean([_white(spun[:, axis], hz) ** 2 for axis in (0, 1)]))),
    )


def _smoothed(time_s: FloatArray, values: FloatArray, hz: float, at_s: FloatArray) -> FloatArray:
    even = np.arange(time_s[0], time_s[-1] + 0.5 / hz, 1.0 / hz)
    low = gaussian_filter1d(np.interp(even, time_s, values), _SMOOTH_S * hz, mode="nearest")
    return np.interp(at_s, even, low)


def _white(values: FloatArray, hz: float) -> float:
    """Standard deviation of a reading's white noise, from frequencies that no hand reaches."""
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(values.size))) ** 2
    frequency = np.fft.rfftfreq(values.size, 1.0 / hz)
    above = frequency > max(_TREMOR_HZ * 1.3, 0.3 * hz)
    energy = np.sum(np.hanning(values.size) ** 2)
    return float(np.sqrt(np.mean(power[above]) / energy)) + 1e-9


def _require_sampling(time_s: FloatArray, frame_time_s: FloatArray, gap_s: float) -> None:
    first, last = frame_time_s[0], frame_time_s[-1]
    if time_s.size < 20:
        raise InsufficientDataError(
            f"inertial scale: expected readings of the orientation sensor over the frames, got {time_s.size}"
        )
    hz = 1.0 / float(np.median(np.diff(time_s)))
    if hz < LEAST_HZ:
        raise InsufficientDataError(
            f"inertial scale: expected at least {LEAST_HZ:g} readings a second, got {hz:.0f}; set the "
            "sensor to a higher rate"
        )
    gap = float(np.diff(time_s).max())
    if gap > gap_s or time_s[0] > first + gap_s or time_s[-1] < last - gap_s:
        raise InsufficientDataError(
            f"inertial scale: expected readings from {first:.2f} to {last:.2f} s and gaps up to {gap_s:g} s, "
            f"got {time_s[0]:.2f} to {time_s[-1]:.2f} s with one of {gap:.2f} s"
        )


def gravity_error(force: FloatArray) -> float:
    """How far the accelerometer's gravity is off, relative: so far may its scale be."""
    return abs(float(np.median(np.linalg.norm(force, axis=1))) / GRAVITY_M_S2 - 1.0)


def _require_gravity(force: FloatArray) -> None:
    felt = float(np.median(np.linalg.norm(force, axis=1)))
    if not gravity_error(force) <= _GRAVITY_SHARE:
        raise MismatchError(
            f"inertial scale: expected an accelerometer that feels gravity as 9.8 m/s^2, got {felt:.3g}; its "
            "readings are in other units, or its scale is not calibrated"
        )


def _require_unsaturated(values: FloatArray, name: str, unit: str) -> None:
    for axis, column in zip("xyz", values.T, strict=True):
        distinct = np.unique(column)
        if distinct.size < 3:
            raise InsufficientDataError(
                f"inertial scale: expected readings that change, got the {name}'s {axis} at "
                f"{distinct[0]:.3g} {unit} throughout; is the sensor read?"
            )
        quantum = float(np.diff(distinct).min())
        for extreme in (distinct[0], distinct[-1]):
            far = abs(extreme - np.median(column)) > _RANGE_STEPS * quantum
            if far and _longest(column == extreme) >= _HELD:
                raise InsufficientDataError(
                    f"inertial scale: expected readings within the sensor's range, got its {name}'s {axis} "
                    f"at a limit of {extreme:.3g} {unit}; choose a larger range, or move more gently"
                )


def _longest(there: BoolArray) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0
