"""Sensors against themselves. A sensor is left out only for contradicting itself, by a `refuted` doubt.

What images and sensors say differently is in `speckle3d.examine.disagreements`: either may be wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import MismatchError
from speckle3d.core.geometry import nearest_rotation
from speckle3d.core.leastsquares import robust_sigma
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker
from speckle3d.examine.conventions import doubts_of_gravity, doubts_of_gyroscope
from speckle3d.motion.direction import LEAST_FRAMES

LONGEST_STILL_S = 0.5
"""Beyond which unchanged readings are told: loggers repeat one until the next."""
MOST_STILL = 0.2
"""Share of the sweep over which readings that do not change at all refute a sensor."""
LEAST_TRAVEL_MM = 0.5
"""By which images must have moved meanwhile: a probe may rest, and a simulated sensor have no noise."""
DOUBTFUL_JITTER, ABSURD_JITTER = 1.5, 10.0
"""Jitter of a step, mm and degrees, that is told, and that refutes; of sensors in use below 0.5 and 0.3."""
MOST_SPIKES = 0.3
"""Share of readings; with more, there is no stream that spikes stand out of."""
_WINDOW = 9
"""Readings of which the median is taken: up to four spikes in a row do not move it."""
_SPIKE_SIGMA = 10.0
_SPIKE = float(np.deg2rad(5.0)), 3.0
"""Turn, rad, and distance, mm, that no hand goes and comes back between readings: at 50 Hz it would take 220
rad/s^2 and 7 m/s^2."""
_SLIP = float(np.deg2rad(300.0)), 250.0
"""Rates, rad/s and mm/s, of no scan, from one reading to the next."""
_STILL = 1e-9
"""Readings closer than this are the same: noise moves the last digits of any sensor that is read."""


class SensorVerdict(NamedTuple):
    """What may be used of a sweep's sensors.

    Attributes
    ----------
    credible : Sweep
        Without the sensors that contradict themselves.
    tells_direction : bool
        Whether a gyroscope or the images' roll confirm how the orientation sensor turns, without which it
        tells no sign of the motion.
    doubts : tuple of Doubt
    """

    credible: Sweep
    tells_direction: bool
    doubts: tuple[Doubt, ...]


def examine_sensors(sweep: Sweep, image: RigidTransform, examine: bool = True) -> SensorVerdict:
    """Examine the sensors of a sweep, or trust them all.

    Parameters
    ----------
    image : RigidTransform, length n
        Image-based poses, of either sign of the elevational motion: they tell whether the probe moved.
    """
    if not examine:
        return SensorVerdict(sweep, True, ())
    repaired, doubts = repair_readings(sweep)
    left = credible_sensors(repaired, doubts)
    for sensor in (left.tracker, left.orientation):
        if sensor is not None:
            odd = (*_doubt_still(sensor, sweep, image), *_doubt_jitter(sensor))
            if not odd and isinstance(sensor, OrientationSensor):
                _, turn_jitter = jitter(rigid(sensor.readings.world_from_sensor), np.zeros(3))
                odd = (*doubts_of_gyroscope(sensor, turn_jitter), *doubts_of_gravity(sensor))
            doubts += odd
    credible = credible_sensors(left, doubts)
    sensor, suspects = credible.orientation, {doubt.about for doubt in doubts}
    tells_direction = sensor is not None and (
        (sensor.gyroscope_rad_s is not None and sensor.label not in suspects)
        or _roll_agrees(sensor, sweep, image)
    )
    return SensorVerdict(credible, tells_direction, doubts)


def repair_readings(sweep: Sweep) -> tuple[Sweep, tuple[Doubt, ...]]:
    """Leave out single wild readings, and count them and jumps."""
    doubts: list[Doubt] = []
    for name in ("tracker", "orientation"):
        sensor = getattr(sweep, name)
        wild = np.zeros(0, dtype=bool) if sensor is None else spikes(sensor)
        share = f"{int(wild.sum())} of {wild.size} readings jump away from those around them and back"
        is_noise = wild.sum() > MOST_SPIKES * wild.size
        if is_noise:
            doubts.append(Doubt(sensor.label, "scrambled values", f"expected a path, but {share}", True))
        elif wild.any():
            where = frames_at(sensor, np.flatnonzero(wild), sweep.frame_time_s)
            doubts.append(Doubt(sensor.label, "spikes", f"{share}, and are left out", False, where))
            sensor = without(sensor, wild)
            sweep = replace(sweep, **{name: sensor})
        if sensor is not None and not is_noise:
            doubts += _doubt_jumps(sensor, sweep.frame_time_s)
    return sweep, tuple(doubts)


def credible_sensors(sweep: Sweep, doubts: Iterable[Doubt]) -> Sweep:
    """The sweep without the sensors that are refuted."""
    refuted = {doubt.about for doubt in doubts if doubt.refuted}
    return replace(
        sweep,
        tracker=None if Tracker.label in refuted else sweep.tracker,
        orientation=None if OrientationSensor.label in refuted else sweep.orientation,
    )


def require_credible(doubts: Iterable[Doubt], sensor: OrientationSensor | Tracker | None, where: str) -> None:
    """Raise `MismatchError` for what rests on a sensor that is refuted."""
    for doubt in doubts:
        if sensor is not None and doubt.refuted and doubt.about == sensor.label:
            raise MismatchError(f"{where}: {doubt}; sensors.examine = false uses it as it is")


def _doubt_jitter(sensor: OrientationSensor | Tracker) -> Iterator[Doubt]:
    place, turn = jitter(rigid(sensor.readings.world_from_sensor), np.zeros(3))
    # A step varies twice as much as a reading.
    size = np.sqrt(2.0) * place, np.sqrt(2.0) * np.rad2deg(turn)
    if max(size) > DOUBTFUL_JITTER:
        evidence = f"expected a steady path, got a jitter of {size[0]:.2g} mm and {size[1]:.2g} degrees"
        yield Doubt(sensor.label, "noise or scrambled values", evidence, max(size) > ABSURD_JITTER)


def _doubt_jumps(sensor: OrientationSensor | Tracker, frame_time_s: FloatArray) -> Iterator[Doubt]:
    """Readings that go on elsewhere, faster than any hand: it slipped, or a tracker found itself anew."""
    poses = rigid(sensor.readings.world_from_sensor)
    if len(poses) < 2:
        return
    rate = _steps(poses[:-1], poses[1:]) / np.diff(sensor.readings.time_s)
    limit = np.maximum(_SLIP, _SPIKE_SIGMA * np.median(rate, axis=1))
    jumps = np.flatnonzero((rate > limit[:, None]).any(axis=0)) + 1
    if jumps.size:
        evidence = f"expected a path that a hand can follow, got {jumps.size} jumps in it"
        where = frames_at(sensor, jumps, frame_time_s)
        yield Doubt(sensor.label, "slip, or readings lost and found elsewhere", evidence, False, where)


def _doubt_still(sensor: OrientationSensor | Tracker, sweep: Sweep, image: RigidTransform) -> Iterator[Doubt]:
    """Readings that are all the same while the images move."""
    poses, read_s = rigid(sensor.readings.world_from_sensor), sensor.readings.time_s
    still = (_steps(poses[:-1], poses[1:]) < _STILL).all(axis=0)
    runs = [(read_s[first], read_s[last + 1]) for first, last in runs_of(np.flatnonzero(still))]
    begin, end = max(runs, key=np.ptp, default=(0.0, -1.0))
    time_s = sweep.frame_time_s - sensor.time_offset_s
    during = (time_s >= begin) & (time_s <= end)
    if during.sum() < 2:
        return
    same_s, whole_s = float(np.ptp(time_s[during])), float(np.ptp(time_s))
    path_mm = image[during].apply(sweep.grid.centre_mm)
    travel_mm = float(np.linalg.norm(path_mm - path_mm[0], axis=1).max())
    if travel_mm > LEAST_TRAVEL_MM and same_s > LONGEST_STILL_S:
        evidence = f"expected readings that change, got the same one for {same_s:.2f} of {whole_s:.2f} s"
        where = runs_of(np.flatnonzero(during))
        yield Doubt(sensor.label, "frozen", evidence, same_s > MOST_STILL * whole_s, where)


ROLL_SHARE = 0.6
"""Share of the variance of the images' roll that a sensor must have in common with it to confirm it."""


def _roll_agrees(sensor: OrientationSensor, sweep: Sweep, image: RigidTransform) -> bool:
    """Whether roll, which images know well, is the sensor's."""
    frames = np.flatnonzero(sensor.covers(sweep.frame_time_s))
    if sensor.sensor_from_image is None or frames.size < LEAST_FRAMES:
        return False
    rotations = sensor.world_from_image(sweep.frame_time_s[frames]), image[frames].rotation
    sensor_roll, image_roll = ((turns[0].inv() * turns).as_rotvec()[:, 2] for turns in rotations)
    return bool(np.var(sensor_roll - image_roll) < (1.0 - ROLL_SHARE) * np.var(image_roll))


def rigid(samples: RigidTransform | Rotation) -> RigidTransform:
    """Readings as rigid transforms; an orientation sensor's are all at the origin."""
    return samples if isinstance(samples, RigidTransform) else RigidTransform.from_rotation(samples)


def _steps(poses: RigidTransform, targets: RigidTransform) -> FloatArray:
    """Turn, rad, and distance, mm, from poses to others, shape (2, n)."""
    distance = np.linalg.norm(targets.translation - poses.translation, axis=1)
    return np.stack([(poses.rotation.inv() * targets.rotation).magnitude(), distance])


def spikes(sensor: OrientationSensor | Tracker) -> BoolArray:
    """Which readings lie far off the median of those around them, shape (m,)."""
    poses = rigid(sensor.readings.world_from_sensor)
    place = median_filter(poses.translation, (_WINDOW, 1), mode="mirror")
    matrix = median_filter(poses.rotation.as_matrix(), (_WINDOW, 1, 1), mode="mirror")
    turn = Rotation.from_matrix(nearest_rotation(matrix))
    off = _steps(RigidTransform.from_components(place, turn), poses)
    limits = [max(most, _SPIKE_SIGMA * robust_sigma(size)) for most, size in zip(_SPIKE, off, strict=True)]
    return np.asarray((off > np.array(limits)[:, None]).any(axis=0))


def frames_at(
    sensor: OrientationSensor | Tracker, readings: IntArray, frame_time_s: FloatArray
) -> tuple[tuple[int, int], ...]:
    """Frames nearest to some readings; none for those before the first frame or after the last."""
    time_s = sensor.readings.time_s[readings] + sensor.time_offset_s
    time_s = time_s[(time_s >= frame_time_s[0]) & (time_s <= frame_time_s[-1])]
    middle = (frame_time_s[:-1] + frame_time_s[1:]) / 2
    return runs_of(np.searchsorted(middle, time_s))


def without(sensor: Any, left_out: BoolArray) -> Any:
    """The sensor less some of its readings, and what was measured with them."""
    keep, readings = ~left_out, sensor.readings
    less = replace(readings, time_s=readings.time_s[keep], world_from_sensor=readings.world_from_sensor[keep])
    others = {name: value[keep] for name, value in vars(sensor).items() if isinstance(value, np.ndarray)}
    return replace(sensor, readings=less, **others)


def jitter(poses: RigidTransform, at_mm: FloatArray) -> tuple[float, float]:
    """Standard deviation of the place of a point, mm, and of the turn, rad, of poses but for slow motion."""
    if len(poses) < 3:
        return 0.0, 0.0
    turns = (poses.rotation.mean().inv() * poses.rotation).as_rotvec()
    # A second difference of white noise varies six times as much.
    second = (np.diff(values, 2, axis=0) / np.sqrt(6.0) for values in (poses.apply(at_mm), turns))
    place, turn = (max(robust_sigma(column) for column in component.T) for component in second)
    return place, turn


def runs_of(frames: IntArray) -> tuple[tuple[int, int], ...]:
    """First and last of every run of consecutive frames.

    Parameters
    ----------
    frames : ndarray of int
        In any order; any number of times each.

    Examples
    --------
    >>> runs_of(np.array([7, 3, 4, 4]))
    ((3, 4), (7, 7))
    """
    numbers = np.unique(frames)
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return tuple((int(run[0]), int(run[-1])) for run in runs if run.size)
