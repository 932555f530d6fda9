"""Recordings in invented magnetic fields, whose true orientation is known.

The motion is a simulated hand's; the magnetometer is computed from the true orientation.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from xsens.logs.samples import VECTORS, ImuLog

EARTH_UT = np.array([0.0, 18.0, -45.0])
"""Central Europe's: 48 uT, dipping by 68 degrees; x east, y north, z up as in BROAD."""

NOISE_UT = 0.3
"""Standard deviation of a reading: a common magnetometer's at 100 Hz."""

RESIDUAL = 0.01
"""Of the earth's field, what a calibration leaves of the sensor's own iron; half of it already is good."""

ROOM = 0.02
"""Of the earth's field, what a room without iron near adds here and there."""


class Scene(NamedTuple):
    """A recording and its truth: quaternions, world x east, NaN where the cameras saw nothing."""

    log: ImuLog
    true_wxyz: np.ndarray
    moving: np.ndarray


class Motion(NamedTuple):
    """A recording in the earth's field alone, when the sensor moves, and how it is turned."""

    log: ImuLog
    moving: np.ndarray
    turns: Rotation


def scene(motion, kind, amount, rng):
    """A recording as it would be in such a field or of such a sensor."""
    if kind == "truncated":
        vector = {"gyroscope_rad_s": truncate(motion.log.gyroscope_rad_s, amount, rng)}
    else:
        vector = {"magnetometer_au": with_errors(FIELDS[kind](motion, amount, rng), rng)}
    readings = {name: getattr(motion.log, name) for name in VECTORS} | vector
    log = ImuLog(motion.log.time_s, source=motion.log.source, **readings)
    return Scene(log, motion.turns.as_quat(scalar_first=True), motion.moving)


# -- motions


def simulate_motion(rng, seconds):
    """A hand at 100 Hz: at rest for 3 s, then turning and shifting in waves of 2 s and longer."""
    time_s = np.arange(0.0, seconds, 0.01)
    fade = np.clip((time_s - 3.0) / 1.0, 0.0, 1.0)[:, None]
    turns = Rotation.from_euler("ZYX", fade * wandering(time_s, rng, [0.9, 0.5, 0.5], 2.0))
    shift_m = fade * wandering(time_s, rng, 0.1, 2.0)
    acceleration_m_s2 = np.gradient(np.gradient(shift_m, time_s, axis=0), time_s, axis=0)
    force = turns.inv().apply(acceleration_m_s2 + np.array([0.0, 0.0, 9.81]))
    rate = (turns[:-1].inv() * turns[1:]).as_rotvec() * 100.0
    rate = np.vstack([rate[:1], rate]) + np.deg2rad(rng.normal(0.0, 0.3, 3))
    log = ImuLog(
        time_s,
        force + 0.03 * rng.standard_normal(force.shape),
        rate + np.deg2rad(0.3) * rng.standard_normal(rate.shape),
        turns.inv().apply(EARTH_UT) + NOISE_UT * rng.standard_normal(rate.shape),
        source="simulated",
    )
    return Motion(log, time_s > 3.0, turns)


def wandering(time_s, rng, sd, period_s):
    """Three smooth random functions of time, of given standard deviation and least period."""
    periods = period_s * np.array([1.0, 1.6, 2.7, 4.4])
    phases = rng.uniform(0.0, 2 * np.pi, (4, 3))
    waves = np.sin(2 * np.pi * time_s[:, None, None] / periods[:, None] + phases)
    return np.asarray(sd) * np.sqrt(2.0 / 4.0) * waves.sum(axis=1)


# -- fields, as the sensor reads them, uT


def seen_by(motion, field_ut):
    return motion.turns.inv().apply(field_ut)


def room_ut(motion, rng):
    """The earth's field in a room: a little different from place to place."""
    walked_s = np.cumsum(motion.moving) / motion.log.rate_hz
    return EARTH_UT + wandering(walked_s, rng, ROOM * np.linalg.norm(EARTH_UT), 7.0)


def iron_on_sensor(motion, amount, rng):
    """Iron and a magnet that turn with the sensor."""
    magnet_ut, soft = amount * direction(rng), np.eye(3) + 0.03 * rng.standard_normal((3, 3))
    return seen_by(motion, room_ut(motion, rng)) @ soft.T + magnet_ut


def direction(rng):
    aim = rng.standard_normal(3)
    return aim / np.linalg.norm(aim)


def start(motion, amount, rng):
    """Beside iron until five seconds after the first movement, free two seconds later."""
    begin_s = motion.log.time_s[np.flatnonzero(motion.moving)[0]] + 5.0
    near = np.clip(1.0 - (motion.log.time_s - begin_s) / 2.0, 0.0, 1.0) ** 3
    return seen_by(motion, room_ut(motion, rng) + np.outer(near, amount * direction(rng) * [1.0, 1.0, 0.5]))


def drift(motion, amount, rng):
    """A field that turns about up by so many degrees in a minute."""
    turns = Rotation.from_euler("z", amount * motion.log.time_s[:, None] / 60.0, degrees=True)
    return seen_by(motion, turns.apply(room_ut(motion, rng)))


def wander(motion, amount, rng):
    """A field that goes astray as a random walk, by so many uT at most."""
    steps = np.cumsum(rng.standard_normal((len(motion.log), 3)), axis=0)
    astray = uniform_filter1d(steps, 400, axis=0, mode="nearest")
    return seen_by(motion, room_ut(motion, rng) + amount * astray / np.abs(astray).max())


FIELDS = {
    "attached": iron_on_sensor,
    "start": start,
    "drift": drift,
    "wander": wander,
}


# -- other sensors


def with_errors(readings, rng):
    """What a calibration leaves of the sensor's iron, and noise."""
    residual = np.eye(3) + RESIDUAL * rng.standard_normal((3, 3))
    readings = readings @ residual.T + RESIDUAL * np.linalg.norm(EARTH_UT) * rng.standard_normal(3)
    return readings + NOISE_UT * rng.standard_normal(readings.shape)


def truncate(rate, step_deg, rng):
    """Coarser steps, cut toward zero, about another bias: at rest it differs from that in motion."""
    step = np.deg2rad(step_deg)
    return np.trunc((rate + rng.uniform(-0.5, 0.5, 3) * step) / step) * step
