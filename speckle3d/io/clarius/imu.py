"""Sensor of a Clarius scanner: samples of ``*_imu.yml`` and their conventions.

Units as read: gyroscope in rad/s, accelerometer in g (stored x 9.80665 as m/s^2), magnetometer in gauss
(stored as it is, in arbitrary units), time in nanoseconds on the clock of the frames. That the gyroscope is
in rad/s is seen in the two public recordings: its readings differ by multiples of 1.3049e-4, which is 245 /
32768 deg, the step of a sensor with a range of 245 deg/s, in rad (the maker's notes for another interface
say deg/s [1]_). The accelerometer's norm at rest is 0.92 and 0.96 there, not 1: its scale is not
calibrated, and is left so. The magnetometer's is 1.19 and 1.14, twice the earth's field.

The quaternion is documented by its names, q0 to q3, alone. It is taken scalar first, ``world_from_sensor``,
and believed where it turns the measured acceleration to the world's vertical: within 0.7 deg in both public
recordings.

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

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.constants import g
from scipy.spatial.transform import Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import RIGID_TOLERANCE
from speckle3d.core.streams import TimedRotations
from speckle3d.core.sweep import INERTIAL, OrientationSensor
from speckle3d.io.clarius.package import Member
from speckle3d.io.pose_paths import usable
from speckle3d.io.recordings import Row
from speckle3d.io.text import parse_number

MEANING = "scalar first, world from sensor"

_VECTORS = [f"{name} {axis}" for name in ("accelerometer", "gyroscope", "magnetometer") for axis in "xyz"]
_NAMES = ["timestamp", *_VECTORS, "q0", "q1", "q2", "q3"]
_FIELD = re.compile(r"(\w[\w ]*): *([-+.\w]+)")
_MOST_OFF_DEG = 10.0
"""A hand's accelerations of a tenth of g tilt what is measured by 6 deg."""
_LEAST_G, _MOST_G = 0.8, 1.2
"""0.92 and 0.96 in the recordings at hand."""


@dataclass(frozen=True)
class SensorSamples:
    """Valid samples of the sensor.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        On the frames' clock.
    vectors : dict of str to ndarray, shape (m, 3), or None
        By their names in an `OrientationSensor`. The accelerometer's are specific force: what is measured, or
        against it, as the quaternion's z tells; against it where the quaternion is not believed, as in both
        public recordings.
    world_from_sensor : Rotation, optional
        None where there is no quaternion, or it does not agree with gravity.
    rows : list of Row
        What the sensor recorded, and how well its quaternion agrees with gravity.
    remarks : list of str
        Samples left out, and what is odd of the others.
    """

    time_s: FloatArray
    vectors: dict[str, Any]
    world_from_sensor: Rotation | None
    rows: list[Row]
    remarks: list[str]

    @property
    def orientation(self) -> OrientationSensor | None:
        """Stream of a sweep, whose world is z up; None where the quaternion is not believed."""
        if self.world_from_sensor is None:
            return None
        return OrientationSensor(TimedRotations(self.time_s, self.world_from_sensor), **self.vectors)


def read_samples(member: Member) -> SensorSamples:
    """Read the sensor's samples, and check their quaternion against gravity.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If no sample is of use.
    """
    documents = filter(str.strip, re.split(r"^---.*$", member.text(), flags=re.MULTILINE))
    fields = map(dict, map(_FIELD.findall, documents))
    rows = [[parse_number(sample.get(name, "")) for name in _NAMES] for sample in fields]
    stamps, table = np.split(np.array(rows).reshape(-1, len(_NAMES)), [1], axis=1)
    # A magnetometer and a quaternion are in some files alone.
    has_column = np.isfinite(table).sum(axis=0) > 0.5 * len(table)
    table[:, ~has_column] = 0.0
    sound = np.isfinite(table).all(axis=1) & table[:, :3].any(axis=1)
    has_quaternion = has_column[9:].all()
    if has_quaternion:
        sound &= np.abs(np.linalg.norm(table[:, 9:], axis=1) - 1.0) < RIGID_TOLERANCE
    faults = np.where(sound, "", "without a value, or a quaternion of unit length").astype(object)
    repeats = np.flatnonzero(sound)[1:][(np.diff(table[sound], axis=0) == 0).all(axis=1)]
    faults[repeats] = "with the values of the one before"
    places, remarks = usable("samples of the sensor", stamps[:, 0] / 1e9, faults.tolist())
    if not places.size or not has_column[:6].all():
        raise InvalidInputError(f"{member.where}: expected samples of the sensor, got none of use")
    measured_g, gyroscope, magnetometer, wxyz = np.split(table[places], [3, 6, 9], axis=1)
    norms = np.linalg.norm(measured_g, axis=1)
    if not _LEAST_G <= np.median(norms) <= _MOST_G:
        remarks.append(
            f"the accelerometer's median norm is {np.median(norms):.3g} g, and 1 g is felt at rest: its unit "
            "or scale is another than assumed"
        )
    rotation, sign, fault, facts = None, -1.0, "is missing", list[Row]()
    if has_quaternion:
        rotation = Rotation.from_quat(wxyz, scalar_first=True)
        along = rotation.apply(measured_g)[:, 2] / norms
        sign = 1.0 if along.mean() >= 0 else -1.0
        off = np.rad2deg(np.sqrt(np.mean(np.arccos(np.clip(sign * along, -1.0, 1.0)) ** 2)))
        meaning = "specific force" if sign > 0 else "gravity (against the world's z): negated"
        facts = [
            ("quaternion, off the vertical", f"{off:.2f}", "deg RMS"),
            ("accelerometer taken as", meaning, ""),
            ("quaternion taken as", MEANING, ""),
        ]
        if off >= _MOST_OFF_DEG:
            rotation, sign, fault = None, -1.0, "does not agree with gravity"
    if rotation is None:
        remarks.append(
            f"the sensor's quaternion {fault}: the sweep has no orientation, which `speckle3d imu orient "
            f"{member.path} --into SWEEP.h5` finds"
        )
    streams = sign * g * measured_g, gyroscope, magnetometer if has_column[6:9].all() else None
    vectors = dict(zip(INERTIAL, streams, strict=True))
    return SensorSamples(stamps[places, 0] / 1e9, vectors, rotation, facts, remarks)
