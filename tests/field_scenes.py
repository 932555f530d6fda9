"""Recordings in invented magnetic fields, whose true orientation is known.

The gyroscope and the accelerometer are those of a BROAD trial, errors and all; the magnetometer is computed
from the optical orientation. `tune` scenes may guide the choice of settings, `judge` scenes, of other trials
and seeds, only tell how good the choice was.
"""

from typing import NamedTuple

import numpy as np
from broad import read_trial, trials_in
from scipy.spatial.transform import Rotation, Slerp

from xsens.logs.samples import VECTORS, ImuLog

EARTH_UT = np.array([0.0, 18.0, -45.0])
"""Central Europe's: 48 uT, dipping by 68 degrees; x east, y north, z up as in BROAD."""

NOISE_UT = 0.3
"""Standard deviation of a reading: a common magnetometer's at 100 Hz."""

RESIDUAL = 0.01
"""Of the earth's field, what a calibration leaves of the sensor's own iron; half of it already is good."""

ROOM = 0.02
"""Of the earth's field, what a room without iron near adds here and there."""

BRIDGED_S = 0.1
"""In longer gaps of the optical orientation, it is not interpolated, and the magnetometer is missing."""

PLAN = {
    "attached": (2.0, 5.0, 12.0, 30.0, 60.0),  # uT, a magnet on the sensor, with 3 % of soft iron
    "walk": (0.1, 0.2, 0.2, 0.4),  # RMS departure from the earth's field, a fraction of it
    "linger": (0.1, 0.2, 0.4),  # the same, with 20 to 60 s beside one piece of iron
    "passing": (30.0, 200.0),  # uT at the nearest, a few seconds each
    "start": (5.0, 20.0, 60.0),  # uT until 5 s after the first movement
    "drift": (10.0, 30.0),  # degrees of heading over the recording
    "saturated": (40.0,),  # uT
    "frozen": (30.0,),  # s
    "spikes": (100.0,),  # uT, one reading in a hundred
    "truncated": (0.12, 0.25),  # deg/s, the gyroscope's step, cut toward zero as BROAD's own
    "cut": (5.0, 15.0, 25.0, 35.0),  # s of movement left out, and all before: no rest to start from
}
"""Kinds of scene, and how strong; the last two leave the magnetometer as recorded."""


class Scene(NamedTuple):
    """A recording and its truth: quaternions, world x east, NaN where the cameras saw nothing."""

    name: str
    log: ImuLog
    true_wxyz: np.ndarray
    moving: np.ndarray


class Motion(NamedTuple):
    """A recording from the first camera image to the last; `turns` is true wherever `known`."""

    log: ImuLog
    true_wxyz: np.ndarray
    moving: np.ndarray
    turns: Rotation
    known: np.ndarray


def scenes(folder, split):
    """Scenes of a split, `tune` or `judge`, one after the other, of a folder of BROAD trials."""
    half = ("tune", "judge").index(split)
    names = trials_in(folder)[half::2]
    motions = {name: recorded(folder, name) for name in names}
    for kind in PLAN:
        for i, amount in enumerate(PLAN[kind]):
            name = names[(len(kind) + i) % len(names)]
            rng = np.random.default_rng([half, i, *kind.encode()])  # the same whatever else the plan holds
            yield scene(motions[name], kind, amount, rng, name[:2])


def scene(motion, kind, amount, rng, label=""):
    """A recording as it would be in such a field or of such a sensor."""
    name = f"{kind} {amount:g} {label}".rstrip()
    if kind in SENSORS:
        return Scene(name, *SENSORS[kind](motion, amount, rng))
    readings = FIELDS[kind](motion, amount, rng)
    residual = np.eye(3) + RESIDUAL * rng.standard_normal((3, 3))
    readings = readings @ residual.T + RESIDUAL * np.linalg.norm(EARTH_UT) * rng.standard_normal(3)
    readings = readings + NOISE_UT * rng.standard_normal(readings.shape)
    if kind in FAULTS:
        readings = FAULTS[kind](motion, readings, amount, rng)
    log = with_readings(motion.log, magnetometer_au=np.where(motion.known[:, None], readings, np.nan))
    return Scene(name, log, motion.true_wxyz, motion.moving)


def with_readings(log, **changed):
    kept = {name: getattr(log, name) for name in VECTORS}
    return ImuLog(log.time_s, source=log.source, **(kept | changed))


# -- motions


def recorded(folder, name):
    """The motion of a BROAD trial."""
    log, true, moving = read_trial(folder, name)
    seen = np.flatnonzero(np.isfinite(true).all(axis=1))
    part = slice(seen[0], seen[-1] + 1)
    log = ImuLog(
        log.time_s[part] - log.time_s[seen[0]],
        *(getattr(log, each)[part] for each in VECTORS),
        source=name,
    )
    true, seen = true[part], seen - seen[0]
    turns = Slerp(log.time_s[seen], Rotation.from_quat(true[seen], scalar_first=True))(log.time_s)
    after = np.clip(np.searchsorted(seen, np.arange(len(log))), 1, len(seen) - 1)
    known = log.time_s[seen[after]] - log.time_s[seen[after - 1]] < BRIDGED_S
    return Motion(log, true, moving[part], turns, known)


def simulated(rng, seconds, rate_hz=100.0, period_s=2.0):
    """The motion of a hand, in waves of a period and longer: at rest for 3 s, then turning and shifting."""
    time_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    fade = np.clip((time_s - 3.0) / 1.0, 0.0, 1.0)[:, None]
    turns = Rotation.from_euler("ZYX", fade * wandering(time_s, rng, [0.9, 0.5, 0.5], period_s))
    shift_m = fade * wandering(time_s, rng, 0.1, period_s)
    pushed = np.gradient(np.gradient(shift_m, time_s, axis=0), time_s, axis=0)
    force = turns.inv().apply(pushed + np.array([0.0, 0.0, 9.81]))
    rate = (turns[:-1].inv() * turns[1:]).as_rotvec() * rate_hz
    rate = np.vstack([rate[:1], rate]) + np.deg2rad(rng.normal(0.0, 0.3, 3))
    log = ImuLog(
        time_s,
        force + 0.03 * rng.standard_normal(force.shape),
        rate + np.deg2rad(0.3) * rng.standard_normal(rate.shape),
        turns.inv().apply(EARTH_UT) + NOISE_UT * rng.standard_normal(rate.shape),
        source="simulated",
    )
    every = np.ones(len(log), dtype=bool)
    return Motion(log, turns.as_quat(scalar_first=True), time_s > 3.0, turns, every)


def wandering(time_s, rng, sd, period_s):
    """Three smooth random functions of time, of given standard deviation and least period."""
    periods = period_s * np.array([1.0, 1.6, 2.7, 4.4])
    phases = rng.uniform(0.0, 2 * np.pi, (4, 3))
    waves = np.sin(2 * np.pi * time_s[:, None, None] / periods[:, None] + phases)
    return np.asarray(sd) * np.sqrt(2.0 / 4.0) * waves.sum(axis=1)


# -- fields, as the sensor reads them, uT


def seen_by(motion, field_ut):
    return motion.turns.inv().apply(field_ut)


def room(motion, amount, rng):
    """The earth's field in a room: a little different from place to place."""
    return seen_by(motion, room_ut(motion, rng))


def room_ut(motion, rng):
    walked_s = np.cumsum(motion.moving) / motion.log.rate_hz
    return EARTH_UT + wandering(walked_s, rng, ROOM * np.linalg.norm(EARTH_UT), 7.0)


def attached(motion, amount, rng):
    """Iron and a magnet that turn with the sensor."""
    magnet_ut, soft = amount * direction(rng), np.eye(3) + 0.03 * rng.standard_normal((3, 3))
    return room(motion, None, rng) @ soft.T + magnet_ut


def direction(rng, shape=()):
    aim = rng.standard_normal((*shape, 3))
    return aim / np.linalg.norm(aim, axis=-1, keepdims=True)


IRON_M = 0.5
"""Size of a desk's or a column's iron: nearer than that, the field does not grow any more."""


def dipoles(position_m, place_m, moment_a_m2):
    """Field of magnets, shape (k, 3) each, at positions of shape (n, 3), uT."""
    out = np.zeros_like(position_m)
    for place, moment in zip(place_m, moment_a_m2, strict=True):
        apart = position_m - place
        square = (apart**2).sum(axis=1, keepdims=True) + IRON_M**2
        along = apart @ moment
        out += 0.1 * (3.0 * apart * along[:, None] / square**2.5 - moment / square**1.5)
    return out


def walk(motion, amount, rng, stays=False):
    """Indoors among desks, columns and a lift at walking pace, wherever the sensor moves at all."""
    place_m = rng.uniform([0.0, 0.0, -1.2], [20.0, 10.0, 0.3], (60, 3))
    moment = direction(rng, (60,)) * rng.lognormal(0.0, 0.8, (60, 1))
    corners = rng.uniform([0.0, 0.0, 0.0], [20.0, 10.0, 0.0], (80, 3))
    pause_s = np.zeros(80)
    if stays:
        pause_s[1::3] = rng.uniform(20.0, 60.0, 27)
        beside = direction(rng, (27,)) * [0.5, 0.5, 0.0]
        corners[1::3] = place_m[rng.permutation(60)[:27]] * [1.0, 1.0, 0.0] + beside
    lasting_s = np.linalg.norm(np.diff(corners, axis=0), axis=1) / rng.uniform(0.8, 1.4, 79)
    arrive_s = np.concatenate([[0.0], np.cumsum(lasting_s + pause_s[:-1])])
    at_s = np.column_stack([arrive_s, arrive_s + pause_s + 1e-6]).ravel()
    walked_s = np.cumsum(motion.moving) / motion.log.rate_hz
    path = np.column_stack([np.interp(walked_s, at_s, np.repeat(c, 2)) for c in corners.T])
    path = path + 0.05 * wandering(walked_s, rng, 1.0, 1.5)
    iron = dipoles(path, place_m, moment)
    strength = np.sqrt((iron[motion.moving] ** 2).sum(axis=1).mean())
    return seen_by(motion, EARTH_UT + iron * (amount * np.linalg.norm(EARTH_UT) / strength))


def linger(motion, amount, rng):
    return walk(motion, amount, rng, stays=True)


def passing(motion, amount, rng):
    """A magnet goes by six times, each for two to eight seconds."""
    time_s, field = motion.log.time_s, room_ut(motion, rng)
    for middle_s in rng.uniform(0.15, 0.95, 6) * time_s[-1]:
        nearness = 1.0 / (1.0 + ((time_s - middle_s) / rng.uniform(0.5, 2.0)) ** 2) ** 1.5
        turning = np.outer(np.cos(time_s - middle_s), direction(rng))
        field += amount * nearness[:, None] * (turning + 0.5 * direction(rng)) / 1.5
    return seen_by(motion, field)


def start(motion, amount, rng):
    """Beside iron until five seconds after the first movement, free two seconds later."""
    begin_s = motion.log.time_s[np.flatnonzero(motion.moving)[0]] + 5.0
    near = np.clip(1.0 - (motion.log.time_s - begin_s) / 2.0, 0.0, 1.0) ** 3
    return seen_by(motion, room_ut(motion, rng) + np.outer(near, amount * direction(rng) * [1.0, 1.0, 0.5]))


def drift(motion, amount, rng):
    """The field's heading, norm and dip go away slowly."""
    part = motion.log.time_s / motion.log.time_s[-1]
    turned = Rotation.from_rotvec(np.outer(np.deg2rad(amount) * part, [0, 0, rng.choice([-1, 1])]))
    return seen_by(
        motion,
        turned.apply(room_ut(motion, rng)) + np.outer(part, 0.05 * np.linalg.norm(EARTH_UT) * direction(rng)),
    )


FIELDS = {
    "attached": attached,
    "walk": walk,
    "linger": linger,
    "passing": passing,
    "start": start,
    "drift": drift,
    **dict.fromkeys(("saturated", "frozen", "spikes"), room),
}


# -- faults of the magnetometer


def during(motion, seconds, rng):
    """A stretch of the recording while the sensor moves, as many seconds long."""
    middle_s = rng.uniform(0.35, 0.65) * motion.log.time_s[-1]
    return np.abs(motion.log.time_s - middle_s) < 0.5 * seconds


def saturated(motion, readings, amount, rng):
    return np.clip(readings, -amount, amount)


def frozen(motion, readings, amount, rng):
    stuck = during(motion, amount, rng)
    return np.where(stuck[:, None], readings[np.flatnonzero(stuck)[0]], readings)


def spikes(motion, readings, amount, rng):
    hit = rng.random(len(readings)) < 0.01
    return readings + np.where(hit[:, None], amount * rng.standard_normal(readings.shape), 0.0)


FAULTS = {"saturated": saturated, "frozen": frozen, "spikes": spikes}


# -- other gyroscopes: log, truth, where it moves


def worse_gyroscope(motion, rate):
    return with_readings(motion.log, gyroscope_rad_s=rate), motion.true_wxyz, motion.moving


def truncated(motion, amount, rng):
    """Coarser steps, cut toward zero, about another bias: at rest it differs from that in motion."""
    step = np.deg2rad(amount)
    rate = motion.log.gyroscope_rad_s + rng.uniform(-0.5, 0.5, 3) * step
    return worse_gyroscope(motion, np.trunc(rate / step) * step)


def cut(motion, amount, rng):
    """Only what comes after some seconds of movement."""
    first = np.flatnonzero(np.cumsum(motion.moving) > amount * motion.log.rate_hz)[0]
    vectors = (getattr(motion.log, name)[first:] for name in VECTORS)
    log = ImuLog(motion.log.time_s[first:] - motion.log.time_s[first], *vectors, source=motion.log.source)
    return log, motion.true_wxyz[first:], motion.moving[first:]


SENSORS = {
    "cut": cut,
    "truncated": truncated,
}
