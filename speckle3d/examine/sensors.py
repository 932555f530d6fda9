"""Sensors against themselves. A sensor is left out only for contradicting itself, by a `refuted` doubt.

What images and sensors say differently is in `speckle3d.examine.disagreements`: either may be wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import MismatchError
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker
from speckle3d.examine.conventions import doubts_of_gravity, doubts_of_gyroscope
from speckle3d.examine.readings import (
    Sensor,
    frames_at,
    jitter,
    rigid,
    runs_of,
    slips,
    spikes,
    standstill,
    without,
)

REPEATED_S, LONGEST_STILL_S = 0.15, 0.5
"""Loggers repeat a reading until the next; beyond the second time, unchanged readings are told."""
MOST_STILL = 0.2
"""Share of the sweep over which readings that do not change at all refute a sensor."""
MOVED_MM = 0.5
"""By which images must have moved meanwhile: a probe may rest, and a simulated sensor have no noise."""
SHAKING, SCRAMBLED = 1.5, 10.0
"""Jitter of a step, mm and degrees, that is told, and that refutes; of sensors in use below 0.5 and 0.3."""
MOST_SPIKES = 0.3
"""Share of readings; with more, there is no stream that spikes stand out of."""


@dataclass(frozen=True)
class ExaminedSensors:
    """What may be used of a sweep's sensors.

    Attributes
    ----------
    trusted : Sweep
        Without the sensors that contradict themselves.
    turn_confirmed : bool
        Whether a gyroscope or the images' roll confirm how the orientation sensor turns, without which it
        tells no sign of the motion.
    doubts : tuple of Doubt
    """

    trusted: Sweep
    turn_confirmed: bool
    doubts: tuple[Doubt, ...]


def examined_sensors(sweep: Sweep, image: RigidTransform, examine: bool = True) -> ExaminedSensors:
    """Examine the sensors of a sweep, or trust them all.

    Parameters
    ----------
    image : RigidTransform, length n
        Image-based poses, of either sign of the elevational motion: they tell whether the probe moved.
    """
    if not examine:
        return ExaminedSensors(sweep, True, ())
    cleaned, doubts = cleaned_readings(sweep)
    left = believed(cleaned, doubts)
    for sensor in (left.tracker, left.orientation):
        if sensor is not None:
            doubts += tuple(_doubts_of(sensor, sweep, image))
    trusted = believed(left, doubts)
    sensor, doubted = trusted.orientation, {doubt.about for doubt in doubts}
    confirmed = sensor is not None and (
        (sensor.gyroscope_rad_s is not None and sensor.label not in doubted)
        or _roll_agrees(sensor, sweep, image)
    )
    return ExaminedSensors(trusted, confirmed, doubts)


def _doubts_of(sensor: OrientationSensor | Tracker, sweep: Sweep, image: RigidTransform) -> list[Doubt]:
    """What is odd about one sensor, most telling first."""
    found = [*_frozen(sensor, sweep, image), *_shaking(sensor)]
    if not found and isinstance(sensor, OrientationSensor):
        found += [*doubts_of_gyroscope(sensor), *doubts_of_gravity(sensor)]
    return found


def cleaned_readings(sweep: Sweep) -> tuple[Sweep, tuple[Doubt, ...]]:
    """Leave out single wild readings, and count them and jumps."""
    doubts: list[Doubt] = []
    for name in ("tracker", "orientation"):
        sensor = getattr(sweep, name)
        if sensor is not None:
            sweep = replace(sweep, **{name: _cleaned(sensor, sweep.frame_time_s, doubts)})
    return sweep, tuple(doubts)


def _cleaned(sensor: Sensor, frame_time_s: FloatArray, doubts: list[Doubt]) -> Sensor:
    wild = spikes(sensor)
    if not wild.any():
        doubts += _slips(sensor, frame_time_s)
        return sensor
    share = f"{int(wild.sum())} of {wild.size} readings jump away from those around them and back"
    if wild.mean() > MOST_SPIKES:
        doubts.append(Doubt(sensor.label, "scrambled values", f"expected a path, but {share}", True))
        return sensor
    where = frames_at(sensor, np.flatnonzero(wild), frame_time_s)
    steady = without(sensor, wild)
    doubts.append(Doubt(sensor.label, "spikes", f"{share}, and are left out", False, where))
    doubts += _slips(steady, frame_time_s)
    return steady


def believed(sweep: Sweep, doubts: Iterable[Doubt]) -> Sweep:
    """The sweep without the sensors that are refuted."""
    refuted = {doubt.about for doubt in doubts if doubt.refuted}
    if not refuted & {Tracker.label, OrientationSensor.label}:
        return sweep
    return replace(
        sweep,
        tracker=None if Tracker.label in refuted else sweep.tracker,
        orientation=None if OrientationSensor.label in refuted else sweep.orientation,
    )


def require_believed(doubts: Iterable[Doubt], sensor: OrientationSensor | Tracker | None, where: str) -> None:
    """Raise `MismatchError` for what rests on a sensor that is refuted."""
    for doubt in doubts:
        if sensor is not None and doubt.refuted and doubt.about == sensor.label:
            raise MismatchError(f"{where}: {doubt}; sensors.examine = false uses it as it is")


def _shaking(sensor: OrientationSensor | Tracker) -> Iterator[Doubt]:
    place, turn = jitter(rigid(sensor.readings.world_from_sensor), np.zeros(3))
    # A step varies twice as much as a reading.
    size = np.sqrt(2.0) * place, np.sqrt(2.0) * np.rad2deg(turn)
    if max(size) > SHAKING:
        evidence = f"expected a steady path, got a jitter of {size[0]:.2g} mm and {size[1]:.2g} degrees"
        yield Doubt(sensor.label, "noise or scrambled values", evidence, max(size) > SCRAMBLED)


def _slips(sensor: OrientationSensor | Tracker, frame_time_s: FloatArray) -> Iterator[Doubt]:
    """Readings that go on elsewhere: a sensor that slipped, or a tracker that found itself anew."""
    found = slips(sensor)
    if found.size:
        evidence = f"expected a path that a hand can follow, got {found.size} jumps in it"
        where = frames_at(sensor, found, frame_time_s)
        yield Doubt(sensor.label, "slip, or readings lost and found elsewhere", evidence, False, where)


def _frozen(sensor: OrientationSensor | Tracker, sweep: Sweep, image: RigidTransform) -> Iterator[Doubt]:
    """Readings that are all the same while the images move."""
    begin, end = standstill(sensor)
    time_s = sweep.frame_time_s - sensor.time_offset_s
    during = (time_s >= begin) & (time_s <= end)
    if during.sum() < 2:
        return
    still, whole = float(np.ptp(time_s[during])), float(np.ptp(time_s))
    path_mm = image[during].apply(sweep.grid.centre_mm)
    moved = float(np.linalg.norm(path_mm - path_mm[0], axis=1).max())
    refuted = still > max(REPEATED_S, MOST_STILL * whole)
    if moved > MOVED_MM and (refuted or still > LONGEST_STILL_S):
        evidence = f"expected readings that change, got the same one for {still:.2f} of {whole:.2f} s"
        yield Doubt(sensor.label, "frozen", evidence, refuted, runs_of(np.flatnonzero(during)))


ROLL_EXPLAINED = 0.6
"""Share of the variance of the images' roll that a sensor must have in common with it to confirm it."""
FEWEST_FRAMES = 20


def _roll_agrees(sensor: OrientationSensor, sweep: Sweep, image: RigidTransform) -> bool:
    """Whether roll, which images know well, is the sensor's."""
    covered = np.flatnonzero(sensor.covers(sweep.frame_time_s))
    if sensor.sensor_from_image is None or covered.size < FEWEST_FRAMES:
        return False
    turned = sensor.world_from_image(sweep.frame_time_s[covered]), image[covered].rotation
    sensed, seen = ((turns[0].inv() * turns).as_rotvec()[:, 2] for turns in turned)
    return bool(np.var(sensed - seen) < (1.0 - ROLL_EXPLAINED) * np.var(seen))
