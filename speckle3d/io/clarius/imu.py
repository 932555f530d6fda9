"""The sensor of a Clarius scanner: samples of ``*_imu.yml``, and what their quaternion means.

Units as read: gyroscope in rad/s, accelerometer in g (stored x 9.80665 as m/s^2), magnetometer in gauss
(stored as it is, in arbitrary units), time in nanoseconds on the clock of the frames. That the gyroscope is
in rad/s is seen in the two public recordings: its readings differ by multiples of 1.3049e-4, which is 245 /
32768 deg, the step of a sensor with a range of 245 deg/s, in rad (the maker's notes for another interface
say deg/s [1]_). The accelerometer's norm at rest is 0.92 and 0.96 there, not 1: its scale is not
calibrated, and is left so. The magnetometer's is 1.19 and 1.14, twice the earth's field.

The quaternion is documented by its names, q0 to q3, alone. In every recording it is taken as each of four
candidates: scalar first or last, ``world_from_sensor`` or its inverse. A candidate fits if it turns the
measured acceleration to the world's vertical, and turns as much between samples as the gyroscope says; of
those that fit, the first is used unless another fits twice as well. In both recordings scalar first,
``world_from_sensor`` fits to 0.7 deg. They are too still for the gyroscope to tell.

With it, the measured acceleration points along the world's -z in both. Either z is down and the sensor
measures specific force (up at rest), or z is up and it gives the direction of gravity. The second is
assumed, and the accelerometer negated, so that it is specific force as elsewhere in this package: (1) the
magnetic field then dips by 73 and 61 deg, as where the maker is (69 deg), and in the first case it would
rise; (2) in the recording of a wire phantom the sensor's x, on which the maker has the array in front of
the sensor [1]_, then points down, at the phantom. The field's horizontal part is within 8 deg of x: the
world is x magnetic north, y west, z up, the world of this package. Were the first case true, the world
would be upside down, not mirrored: relative orientations do not depend on it.

Not known: the sensor's axes in the housing beyond that figure, hence its mounting, which `calibrate
orientation` finds; which sensor and filter there is, hence the quaternion's accuracy and delay.

References
----------
.. [1] clariusdev/motion, README.md: units and the sensor's location.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import RIGID_TOLERANCE
from speckle3d.core.streams import DEFAULT_MAX_GAP_S, TimedRotations
from speckle3d.core.sweep import OrientationSensor
from speckle3d.io.clarius.documents import documents_of, quantity, shown
from speckle3d.io.clarius.package import Member

G_M_S2 = 9.80665

MEANINGS = (
    "scalar first, world from sensor",
    "scalar first, sensor from world",
    "scalar last, world from sensor",
    "scalar last, sensor from world",
)
"""What a quaternion q0 to q3 may mean, the likeliest first."""

_AXES = "xyz"
_STAMP = re.compile(r"[0-9]{1,19}")
_MOST_OFF_DEG = 10.0
"""A hand's accelerations of a tenth of g tilt what is measured by 6 deg."""

_LEAST_G, _MOST_G = 0.8, 1.2
"""0.92 and 0.96 in the recordings at hand."""

_SURE_DEG = 1.0
_WINDOW_S = 0.25
_STILL_DEG = 2.0
"""Below this rotation in a window, noise and the gaps between samples hide what the gyroscope tells: both
recordings at hand have 0.2 to 1 deg, by the quaternion, that is not in the gyroscope's readings."""

_PAUSE_S = 0.03
"""Longer than two periods at 80 Hz: a burst has ended."""


@dataclass(frozen=True)
class SensorSamples:
    """Samples of the sensor in the file's order, repeated ones dropped.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        On the frames' clock.
    accelerometer_g, gyroscope_rad_s : ndarray, shape (m, 3)
        As in the file.
    magnetometer_gauss : ndarray, shape (m, 3), optional
    quaternion : ndarray, shape (m, 4), optional
        q0 to q3.
    repeated : int
        Samples left out.
    """

    where: str
    time_s: FloatArray
    accelerometer_g: FloatArray
    gyroscope_rad_s: FloatArray
    magnetometer_gauss: FloatArray | None
    quaternion: FloatArray | None
    repeated: int

    def __len__(self) -> int:
        return int(self.time_s.size)

    def accelerometer_m_s2(self, fit: Fit | None) -> FloatArray:
        """Specific force, shape (m, 3): what is measured, or against it, as the quaternion's z tells.

        Against it where no quaternion fits, as in both public recordings.
        """
        return (-1.0 if fit is None else fit.vertical) * G_M_S2 * self.accelerometer_g


@dataclass(frozen=True)
class Fit:
    """How well one meaning of the quaternion agrees with the sensor's other readings.

    Attributes
    ----------
    vertical : float
        1 where the measured acceleration points along the world's z, -1 where against it.
    off_vertical_deg : float
        RMS angle of the acceleration from it.
    off_gyroscope_deg, turned_deg : float
        RMS difference from the gyroscope in windows of 0.25 s, and what the gyroscope says; NaN without such.
    """

    meaning: str
    world_from_sensor: Rotation
    vertical: float
    off_vertical_deg: float
    off_gyroscope_deg: float
    turned_deg: float

    @property
    def still(self) -> bool:
        """Whether the recording turns too little for the gyroscope to tell."""
        return not self.turned_deg > _STILL_DEG

    @property
    def fits(self) -> bool:
        """Whether it may be what is meant."""
        agrees = self.still or self.off_gyroscope_deg < self.turned_deg / 2
        return self.off_vertical_deg < _MOST_OFF_DEG and agrees

    @property
    def off_deg(self) -> float:
        """Both differences together."""
        return float(np.hypot(self.off_vertical_deg, 0.0 if self.still else self.off_gyroscope_deg))


def read_samples(member: Member) -> SensorSamples:
    """Read the sensor's samples.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        Naming the sample whose clock goes back, or whose field is missing.
    """
    where = member.where
    rows: list[FloatArray] = []
    times: list[int] = []
    seen: dict[int, int] = {}
    repeated = 0
    for i, fields in enumerate(documents_of(member.text(), where)):
        stamp = fields.get("timestamp")
        if not isinstance(stamp, str) or _STAMP.fullmatch(stamp) is None or int(stamp) >= 2**63:
            raise InvalidInputError(
                f"{where}: sample {i}: timestamp: expected nanoseconds, got {shown(stamp)}"
            )
        time_ns = int(stamp)
        row = _row(fields, f"{where}: sample {i}")
        known = seen.get(time_ns, len(rows) - 1 if rows else None)
        if known is not None and np.array_equal(rows[known], row, equal_nan=True):
            repeated += 1
            continue
        if times and time_ns <= times[-1]:
            raise InvalidInputError(
                f"{where}: sample {i}: timestamp: expected one after {times[-1]} ns, got {time_ns} ns: the "
                "clock was reset, or samples are out of order"
            )
        seen[time_ns] = len(rows)
        rows.append(row)
        times.append(time_ns)
    if not rows:
        raise InvalidInputError(f"{where}: expected samples of the sensor, got none")
    table = np.array(rows)
    _require_alike(where, table)
    magnetometer, quaternion = table[:, 6:9], table[:, 9:]
    return SensorSamples(
        where=where,
        time_s=np.array(times, dtype=np.int64) / 1e9,
        accelerometer_g=table[:, :3],
        gyroscope_rad_s=table[:, 3:6],
        magnetometer_gauss=None if np.isnan(magnetometer).all() else magnetometer,
        quaternion=None if np.isnan(quaternion).all() else _unit(where, quaternion),
        repeated=repeated,
    )


def fits_of(samples: SensorSamples) -> tuple[Fit, ...]:
    """Try each meaning of the quaternion, the likeliest first; none where there is no quaternion."""
    if samples.quaternion is None:
        return ()
    first, last = (Rotation.from_quat(samples.quaternion, scalar_first=order) for order in (True, False))
    candidates = (first, first.inv(), last, last.inv())
    return tuple(_fit(samples, *each) for each in zip(MEANINGS, candidates, strict=True))


def meaning_of(fits: tuple[Fit, ...]) -> Fit | None:
    """Choose what the quaternion means; None where nothing fits."""
    fitting = [each for each in fits if each.fits]
    if not fitting:
        return None
    best = min(fitting, key=lambda each: each.off_deg)
    likely = fitting[0]
    return likely if likely.off_deg < max(2 * best.off_deg, _SURE_DEG) else best


def orientation_sensor(samples: SensorSamples, fit: Fit) -> OrientationSensor:
    """Make the orientation stream of a sweep; its world is z up, its accelerometer specific force."""
    return OrientationSensor(
        TimedRotations(samples.time_s, fit.world_from_sensor),
        accelerometer_m_s2=samples.accelerometer_m_s2(fit),
        gyroscope_rad_s=samples.gyroscope_rad_s,
        magnetometer_au=samples.magnetometer_gauss,
    )


def sensor_rows(samples: SensorSamples, fits: tuple[Fit, ...]) -> list[tuple[str, str, str]]:
    """Tell what the sensor recorded, and what its quaternion was found to mean."""
    steps = np.diff(samples.time_s)
    pauses = steps[steps > _PAUSE_S]
    rows = [
        ("sensor samples", str(len(samples)), ""),
        ("sensor samples repeated, left out", str(samples.repeated), ""),
        ("sensor pauses", str(pauses.size), f"over {1e3 * _PAUSE_S:g} ms"),
        (
            "sensor pauses not bridged",
            str(np.sum(pauses > DEFAULT_MAX_GAP_S)),
            f"over {DEFAULT_MAX_GAP_S:g} s",
        ),
        ("sensor, longest pause", f"{steps.max(initial=0.0):.3f}", "s"),
        ("accelerometer, median norm", f"{_norm(samples.accelerometer_g):.3f}", "g"),
    ]
    if samples.magnetometer_gauss is not None:
        rows.append(("magnetometer, median norm", f"{_norm(samples.magnetometer_gauss):.3f}", "gauss"))
    rows += [
        (f"quaternion as {each.meaning}, off the vertical", f"{each.off_vertical_deg:.2f}", "deg RMS")
        for each in fits
    ]
    chosen = meaning_of(fits)
    if chosen is None:
        said = "none that the sensor's other readings agree with" if fits else "none in the file"
        return [*rows, ("quaternion", f"{said}: see `speckle3d imu orient`", "")]
    rows.append(("quaternion", f"{chosen.meaning} (checked against the accelerometer)", ""))
    told = (
        "too still to tell" if chosen.still else f"{chosen.off_gyroscope_deg:.2f} of {chosen.turned_deg:.2f}"
    )
    rows.append(("quaternion, off the gyroscope", told, "" if chosen.still else "deg RMS in 0.25 s"))
    sign = "specific force" if chosen.vertical > 0 else "gravity (against the world's z): negated"
    rows.append(("accelerometer taken as", sign, ""))
    if samples.magnetometer_gauss is not None:
        x, y, z = chosen.world_from_sensor.apply(samples.magnetometer_gauss).mean(axis=0)
        rows.append(("magnetic field, from the world's x", f"{np.rad2deg(np.arctan2(y, x)):.0f}", "deg"))
        rows.append(("magnetic field, dip", f"{np.rad2deg(np.arctan2(-z, np.hypot(x, y))):.0f}", "deg"))
    return rows


def sensor_notes(samples: SensorSamples) -> list[str]:
    """Say what a hand cannot feel: another acceleration than about 1 g."""
    norm_g = _norm(samples.accelerometer_g)
    if _LEAST_G <= norm_g <= _MOST_G:
        return []
    guess = " (in m/s^2?)" if _LEAST_G <= norm_g / G_M_S2 <= _MOST_G else ""
    return [
        f"the accelerometer's median norm is {norm_g:.3g} g, and 1 g is felt at rest: its unit or scale is "
        f"another than assumed{guess}"
    ]


def _row(fields: Mapping[str, Any], where: str) -> FloatArray:
    values = [
        quantity(fields.get(f"{name} {axis}"), "", f"{where}: {name} {axis}")
        for name in ("accelerometer", "gyroscope")
        for axis in _AXES
    ]
    values += [
        np.nan if (value := fields.get(f"magnetometer {axis}")) is None else quantity(value, "", where)
        for axis in _AXES
    ]
    quaternion = fields.get("orientation")
    if quaternion is None:
        return np.array([*values, *[np.nan] * 4])
    if not isinstance(quaternion, dict):
        raise InvalidInputError(f"{where}: orientation: expected q0 to q3, got {shown(quaternion)}")
    turn = [quantity(quaternion.get(f"q{i}"), "", f"{where}: orientation: q{i}") for i in range(4)]
    return np.array([*values, *turn])


def _require_alike(where: str, table: FloatArray) -> None:
    """Refuse samples of which some have a magnetometer or a quaternion and some not."""
    for name, columns in (("magnetometer", table[:, 6:9]), ("orientation", table[:, 9:])):
        lacking = np.isnan(columns).any(axis=1)
        if lacking.any() and not lacking.all():
            first = int(np.argmax(lacking))
            raise InvalidInputError(f"{where}: sample {first}: {name}: expected one, got none")


def _unit(where: str, quaternion: FloatArray) -> FloatArray:
    norms = np.linalg.norm(quaternion, axis=1)
    if (bad := np.flatnonzero(np.abs(norms - 1) > RIGID_TOLERANCE)).size:
        raise InvalidInputError(
            f"{where}: sample {bad[0]}: orientation: expected a unit quaternion, got norm {norms[bad[0]]:.6g}"
        )
    return quaternion


def _fit(samples: SensorSamples, meaning: str, world_from_sensor: Rotation) -> Fit:
    norms = np.linalg.norm(samples.accelerometer_g, axis=1)
    felt = norms > 0
    if not felt.any():
        return Fit(meaning, world_from_sensor, 1.0, np.inf, np.nan, np.nan)
    along = world_from_sensor[felt].apply(samples.accelerometer_g[felt])[:, 2] / norms[felt]
    sign = 1.0 if along.mean() >= 0 else -1.0
    off = np.rad2deg(np.sqrt(np.mean(np.arccos(np.clip(sign * along, -1.0, 1.0)) ** 2)))
    turned = _turns(samples, world_from_sensor)
    off_gyroscope, gyroscope = (np.nan, np.nan) if turned is None else turned
    return Fit(meaning, world_from_sensor, sign, float(off), off_gyroscope, gyroscope)


def _turns(samples: SensorSamples, world_from_sensor: Rotation) -> tuple[float, float] | None:
    """RMS difference of quaternion and gyroscope in windows without long pauses, and RMS rotation, deg."""
    time_s, rate = samples.time_s, samples.gyroscope_rad_s
    steps = np.diff(time_s)
    turns = Rotation.from_rotvec(0.5 * (rate[1:] + rate[:-1]) * steps[:, None])
    apart, by_gyroscope = [], []
    first = 0
    while first < steps.size:
        stop = int(np.searchsorted(time_s, time_s[first] + _WINDOW_S))
        stop = min(max(stop, first + 1), steps.size)
        if steps[first:stop].max() <= DEFAULT_MAX_GAP_S:
            turned = Rotation.identity()
            for each in turns[first:stop]:
                turned = turned * each
            found = world_from_sensor[first].inv() * world_from_sensor[stop]
            apart.append((turned.inv() * found).magnitude())
            by_gyroscope.append(turned.magnitude())
        first = stop
    if not apart:
        return None
    rms = (float(np.rad2deg(np.sqrt(np.mean(np.square(values))))) for values in (apart, by_gyroscope))
    return next(rms), next(rms)


def _norm(vectors: FloatArray) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))
