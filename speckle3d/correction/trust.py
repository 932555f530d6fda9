"""Which sensors of a sweep may be believed: each is held against the images and against itself.

A stream is doubted where a fault that it may have explains what the images, its gyroscope and gravity show
far better than the stream as it is. What rests on a refuted sensor is refused; one that is doubted is used,
and the doubt goes with the results.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.doubts import Doubt, runs_of
from speckle3d.core.errors import MismatchError
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker
from speckle3d.correction.evidence import (
    GyroscopeTurns,
    MotionEvidence,
    gravity_from_vertical,
    noise_of,
    total_misfit,
)
from speckle3d.correction.readings import Sensor, frames_at, slips, spikes, standstill, without
from speckle3d.correction.suspects import Suspect, suspects

TRACKER, ORIENTATION = "tracker", "orientation sensor"

_HELD_S, _LONGEST_STILL_S = 0.15, 0.5
"""Loggers repeat a reading until the next; beyond the second time, unchanged readings are told."""
_MOST_STILL = 0.2
"""Share of the sweep over which readings that do not change at all refute a sensor."""
_MOVED_MM = 0.5
"""By which images must have moved meanwhile: a probe may rest, and a simulated sensor have no noise."""
_NOISE, _MOST_NOISE = (1.5, 1.5), (10.0, 10.0)
"""Jitter of a step, mm and degrees: that of sensors in use is below 0.5 and 0.3."""
_MOST_SPIKES = 0.3
"""Share of readings; with more, there is no stream that spikes stand out of."""

# Gains in the logarithm of the likelihood. The bounds stand between good and faulty sweeps, simulated with
# small images (26 to 48 vectors). Conventions and mountings of trackers: good ones up to 1.8, faulty ones
# from 10; of orientation sensors by images alone: 11, by their gyroscope: 0.1, faulty ones from 5; by a
# tracker: 1.8. Clocks: good ones up to 9 by images and 14 by a tracker, a tracker late by 0.5 s from 16.
_POSE_GAIN, _TURN_GAIN, _GYROSCOPE_GAIN = 6.0, 15.0, 4.0
_CLOCK_GAIN, _CLOCK_GAIN_BY_TRACKER = 11.0, 17.0
_CLOCK_RANGE_S = 1.5
_LEAST_CLOCK_S, _WRONG_CLOCK_S = 0.05, 0.3
"""Clocks are calibrated to a frame or two; within the second time a hand has turned round."""
_LEAST_MOUNTING_DEG, _WRONG_MOUNTING_DEG = 8.0, 12.0
"""Calibrations are right to some degrees; beyond the second angle lengths and tilts are no longer."""
_PREFERENCE = 5.0
"""Any mistaken convention is also nearly some mounting; that must be this much better to be suspected."""

_UNEQUAL, _UNEQUAL_SIGMA = 0.06, 3.0
"""Elevational scale between tracker and images: images alone are right to a few per cent."""
_FAR_FROM_EQUAL = 2.0
"""Beyond what curves of another probe do to a length."""
_VERTICAL_DEG, _UPRIGHT_DEG = 25.0, 10.0
_MOST_BIAS_DEG_S = 3.0
"""Biases of gyroscopes in orientation sensors are below 1 degree/s once they have stood still."""
_ROLL_EXPLAINED = 0.6
"""Share of the variance of the images' roll that a sensor must have in common with it to confirm it."""


@dataclass(frozen=True)
class Trust:
    """What the examination of a sweep's sensors found.

    Attributes
    ----------
    doubts : tuple of Doubt
    turn_confirmed : bool
        Whether the images' roll or the gyroscope confirm how the orientation sensor turns, without which it
        tells no sign.
    misled : frozenset of str
        Sensors whose motion is not the images', by clock, mounting or convention: these tell no sign either.
    """

    doubts: tuple[Doubt, ...]
    turn_confirmed: bool
    misled: frozenset[str] = frozenset()


def cleaned_readings(sweep: Sweep) -> tuple[Sweep, tuple[Doubt, ...]]:
    """Leave out single wild readings, and count them.

    Parameters
    ----------
    sweep : Sweep

    Returns
    -------
    Sweep
        With what is left of its sensors' readings.
    tuple of Doubt
    """
    tracker, about_tracker = _cleaned(sweep.tracker, sweep.frame_time_s)
    orientation, about_orientation = _cleaned(sweep.orientation, sweep.frame_time_s)
    doubts = (*about_tracker, *about_orientation)
    return (replace(sweep, tracker=tracker, orientation=orientation) if doubts else sweep), doubts


def believed(sweep: Sweep, doubts: Iterable[Doubt]) -> Sweep:
    """The sweep without the sensors that are refuted."""
    return without_sensors(sweep, frozenset(doubt.about for doubt in doubts if doubt.refuted))


def without_sensors(sweep: Sweep, about: frozenset[str]) -> Sweep:
    """The sweep without sensors of some names, as doubts have them."""
    if not about & {TRACKER, ORIENTATION}:
        return sweep
    return replace(
        sweep,
        tracker=None if TRACKER in about else sweep.tracker,
        orientation=None if ORIENTATION in about else sweep.orientation,
    )


def doubts_of_readings(sweep: Sweep) -> tuple[Doubt, ...]:
    """What the readings of a sweep's sensors say against themselves, without any image: spikes and jumps."""
    cleaned, doubts = cleaned_readings(sweep)
    left = believed(cleaned, doubts)
    sensors = [sensor for sensor in (left.tracker, left.orientation) if sensor is not None]
    return (*doubts, *(each for sensor in sensors for each in _slip_doubts(sensor, sweep.frame_time_s)))


def _cleaned(sensor: Sensor | None, frame_time_s: FloatArray) -> tuple[Sensor | None, list[Doubt]]:
    wild = np.zeros(0, dtype=bool) if sensor is None else spikes(sensor)
    if sensor is None or not wild.any():
        return sensor, []
    share = f"{int(wild.sum())} of {wild.size} readings jump away from those around them and back"
    if wild.mean() > _MOST_SPIKES:
        evidence = f"expected a path, but {share}"
        return sensor, [Doubt(name_of(sensor), "noise or scrambled values", evidence, True)]
    told = f"{share}, and are left out"
    where = frames_at(sensor, np.flatnonzero(wild), frame_time_s)
    return without(sensor, wild), [Doubt(name_of(sensor), "spikes", told, False, where)]


def examine_sensors(sweep: Sweep, image: RigidTransform, length_sigma: float) -> Trust:
    """Hold the sensors of a sweep against its images and against themselves.

    Parameters
    ----------
    sweep : Sweep
        n frames; `cleaned_readings` first. Sensors that are refuted already are not looked at again.
    image : RigidTransform, length n
        Image-based poses; the sign of the elevational motion does not matter.
    length_sigma : float
        Standard error of the images' elevational scale, as a share.

    Returns
    -------
    Trust
    """
    seen = MotionEvidence(sweep.frame_time_s, sweep.grid.centre_mm, image)
    doubts: list[Doubt] = []
    misled: set[str] = set()
    if sweep.tracker is not None and _usable(sweep.tracker, seen):
        found = [*_frozen_doubts(sweep.tracker, seen)] or [
            *_Examination(_Accused(sweep.tracker), seen).doubts()
        ]
        misled |= {doubt.about for doubt in found}
        doubts += [
            *found,
            *_unequal_lengths(sweep.tracker, seen, length_sigma),
            *_slip_doubts(sweep.tracker, seen.time_s),
        ]
    confirmed = False
    if sweep.orientation is not None and _usable(sweep.orientation, seen):
        accused = _Accused(sweep.orientation)
        examination = _Examination(accused, seen)
        found = [*_frozen_doubts(sweep.orientation, seen)] or [*examination.doubts()]
        misled |= {doubt.about for doubt in found}
        if not found and sweep.tracker is not None and not doubts and _usable(sweep.tracker, seen):
            by_tracker = _Examination(accused, _tracked(sweep, sweep.tracker)).doubts()
            # One of the two is wrong, and which is not known.
            found = [
                replace(each, suspect=f"{each.suspect}, or the tracker", refuted=False) for each in by_tracker
            ]
        found = found or [*examination.weak_doubts(), *_gravity_doubts(sweep.orientation)]
        found += _slip_doubts(sweep.orientation, seen.time_s)
        confirmed = examination.turn_confirmed() and not any(doubt.refuted for doubt in found)
        doubts += found
    return Trust(tuple(doubts), confirmed, frozenset(misled))


def _tracked(sweep: Sweep, tracker: Tracker) -> MotionEvidence:
    """Motion as a believed tracker has it, to hold an orientation sensor against."""
    time_s = sweep.frame_time_s[tracker.covers(sweep.frame_time_s)]
    poses = tracker.world_from_image(time_s)
    return MotionEvidence(time_s, sweep.grid.centre_mm, poses, by_images=False)


def name_of(sensor: OrientationSensor | Tracker) -> str:
    """What doubts call a sensor."""
    return TRACKER if isinstance(sensor, Tracker) else ORIENTATION


def require_believed(
    doubts: tuple[Doubt, ...], sensor: OrientationSensor | Tracker | None, where: str
) -> None:
    """Refuse what rests on a sensor that is refuted.

    Raises
    ------
    MismatchError
        Naming the sensor, the evidence and the suspect.
    """
    for doubt in doubts:
        if sensor is not None and doubt.refuted and doubt.about == name_of(sensor):
            raise MismatchError(f"{where}: {doubt}; sensors.examine = false uses it as it is")


def _usable(sensor: OrientationSensor | Tracker, seen: MotionEvidence) -> bool:
    """Whether there is enough of a sensor to be examined."""
    calibrated = sensor.sensor_from_image is not None
    return calibrated and int(sensor.covers(seen.time_s).sum()) >= 10 and bool(seen.lags)


@dataclass(frozen=True)
class _Gain:
    """How much better a suspect explains the evidence, by source."""

    name: str
    images: float
    gyroscope: float = 0.0

    @property
    def total(self) -> float:
        return self.images + self.gyroscope


class _Accused(Generic[Sensor]):
    """A sensor, conventions that may be mistaken, and how much better its gyroscope fits each put right."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor: Sensor = sensor
        self.conventions: tuple[Suspect[Sensor], ...] = tuple(suspects(sensor))
        turns = GyroscopeTurns.of(sensor) if isinstance(sensor, OrientationSensor) else None
        self.gyroscope = turns and turns.compared(sensor.readings.world_from_sensor)
        self.turning = [self._turning(turns, suspect.mended) for suspect in self.conventions]

    def _turning(self, turns: GyroscopeTurns | None, mended: Sensor) -> float:
        # No mounting changes how readings turn.
        if turns is None or self.gyroscope is None or mended.readings is self.sensor.readings:
            return 0.0
        return self.gyroscope.misfit - turns.compared(mended.readings.world_from_sensor).misfit


class _Examination(Generic[Sensor]):
    """One sensor against the images, and against its gyroscope if it has one."""

    def __init__(self, accused: _Accused[Sensor], seen: MotionEvidence) -> None:
        self.accused: _Accused[Sensor] = accused
        self.sensor: Sensor = accused.sensor
        self.seen = seen
        self.about, self.gyroscope = name_of(accused.sensor), accused.gyroscope
        self.noise = noise_of(self.sensor, seen.time_s, seen.centre_mm)
        self.agreements = seen.agreements(self.sensor, self.noise)
        self.misfit = float(total_misfit(self.agreements).item())

    def doubts(self) -> Iterator[Doubt]:
        """At most one: the likeliest fault, if one is far likelier than none."""
        jitter = self.noise[[0, -1]]
        if (jitter > _NOISE).any():
            evidence = (
                f"expected a steady path, got a jitter of {jitter[0]:.2g} mm and {jitter[1]:.2g} degrees"
            )
            yield Doubt(self.about, "noise or scrambled values", evidence, bool((jitter > _MOST_NOISE).any()))
            return
        kinds = self.accused.conventions
        explained = self._gains([kind.mended for kind in kinds])
        conventions = [
            _Gain(kind.name, float(gain), turning)
            for kind, gain, turning in zip(kinds, explained, self.accused.turning, strict=True)
        ]
        conventions.append(_Gain("another recording, or scrambled values", self._gain_of_still()))
        best = max(conventions, key=lambda gain: gain.total)
        turned, degrees = self._mounting()
        late, seconds = self._clock()
        least = _CLOCK_GAIN if self.seen.by_images else _CLOCK_GAIN_BY_TRACKER
        if self._beyond(best) and best.total > max(turned.images - _PREFERENCE, late.images):
            # Where the images go with the readings, it is the gyroscope whose axes are others.
            otherwise = best.images < -_GYROSCOPE_GAIN
            name = f"gyroscope on other axes, or {best.name}" if otherwise else best.name
            yield Doubt(self.about, name, self._evidence(), not otherwise)
        elif late.images > max(least, turned.images):
            side = "later" if seconds > 0 else "earlier"
            whose = "images'" if self.seen.by_images else "tracker's"
            evidence = f"expected motion with the {whose}, got it {abs(seconds):.2f} s {side}"
            refuted = abs(seconds) > _WRONG_CLOCK_S and late.images > 2.0 * least
            yield Doubt(self.about, "clock", evidence, refuted)
        elif self._beyond(turned) and degrees > _LEAST_MOUNTING_DEG:
            evidence = f"{self._evidence()}; turned by {degrees:.0f} degrees it would fit"
            yield Doubt(self.about, turned.name, evidence, degrees > _WRONG_MOUNTING_DEG)

    def weak_doubts(self) -> Iterator[Doubt]:
        """A slow turn that the gyroscope does not have."""
        if self.gyroscope is not None and self.gyroscope.bias > _MOST_BIAS_DEG_S:
            evidence = f"expected turns as its gyroscope's, got {self.gyroscope.bias:.1f} degrees/s more"
            yield Doubt(self.about, "heading drift, or a gyroscope's bias", evidence, False)

    def turn_confirmed(self) -> bool:
        """Whether roll, which images know well, or the gyroscope confirm the turns that are read."""
        if self.gyroscope is not None and self.gyroscope.confirms:
            return True
        telling = [each for each in self.agreements if each.seen[-1] > 2.0 * each.noise[-1]]
        left = [(each.left[-1] / each.seen[-1]) ** 2 for each in telling]
        return bool(left) and max(left) < 1.0 - _ROLL_EXPLAINED

    def _beyond(self, gain: _Gain) -> bool:
        if self.about == TRACKER or not self.seen.by_images:
            return gain.images > _POSE_GAIN
        return gain.total > (_GYROSCOPE_GAIN if gain.gyroscope > _GYROSCOPE_GAIN else _TURN_GAIN)

    def _gains(self, mended: Sequence[Sensor]) -> FloatArray:
        """What each sensor put right would explain of the images."""
        return self.misfit - self.seen.misfits(mended, self.noise)

    def _gain_of_still(self) -> float:
        return self.misfit - float(self.seen.misfits([self.sensor], self.noise, still=True)[0])

    def _mounting(self) -> tuple[_Gain, float]:
        """The rotation of the image on the sensor that fits best, and its angle, degrees."""
        turns = [self.seen.turn(self.sensor, self.noise, sign) for sign in (1, -1)]
        gains = self._gains([_turned(self.sensor, turn, self.seen.centre_mm) for turn in turns])
        best = int(np.argmax(gains))
        return _Gain("mounting", float(gains[best])), float(np.degrees(turns[best].magnitude()))

    def _clock(self) -> tuple[_Gain, float]:
        """The delay at which the shortest steps fit best, s, over the same frames at every delay."""
        pause = float(np.median(np.diff(self.seen.time_s)))
        count = int(_CLOCK_RANGE_S / pause)
        delays: FloatArray = pause * np.arange(-count, count + 1, dtype=float)
        misfit, steps = self.seen.delayed_misfits(self.sensor, self.noise, delays)
        given = misfit[count]
        tried = (steps >= 0.6 * steps[count]) & (np.abs(delays) >= _LEAST_CLOCK_S)
        if not np.isfinite(given) or not tried.any():
            return _Gain("clock", 0.0), 0.0
        gain = np.where(tried, (given - misfit) * steps, -np.inf)
        best = int(np.nanargmax(gain))
        return _Gain("clock", float(gain[best])), float(delays[best])

    def _evidence(self) -> str:
        """What was expected and seen over the longest lag, where it differs most."""
        if not self.agreements:
            return "its gyroscope turns otherwise"
        last = self.agreements[-1]
        names = ("x", "y", "z", "tilt", "yaw", "roll")[-last.left.size :]
        part = int(np.argmax(last.left / last.noise))
        unit = "mm" if names[part] in "xyz" else "degrees"
        whose = "images'" if self.seen.by_images else "tracker's"
        seen = f"expected steps in {names[part]} as the {whose} ({last.seen[part]:.2f} {unit} rms) to "
        return f"{seen}{last.noise[part]:.2f} {unit}, got a difference of {last.left[part]:.2f}"


def _slip_doubts(sensor: OrientationSensor | Tracker, frame_time_s: FloatArray) -> Iterator[Doubt]:
    """Readings that go on elsewhere: a sensor that slipped, or a tracker that found itself anew."""
    found = slips(sensor)
    if found.size:
        evidence = f"expected a path that a hand can follow, got {found.size} jumps in it"
        where = frames_at(sensor, found, frame_time_s)
        yield Doubt(name_of(sensor), "slip, or readings lost and found elsewhere", evidence, False, where)


def _frozen_doubts(sensor: OrientationSensor | Tracker, seen: MotionEvidence) -> Iterator[Doubt]:
    """Readings that are all the same while the images move."""
    begin, end = standstill(sensor)
    time_s = seen.time_s - sensor.time_offset_s
    during = (time_s >= begin) & (time_s <= end)
    if during.sum() < 2:
        return
    still, whole = float(np.ptp(time_s[during])), float(np.ptp(time_s))
    path_mm = seen.image[during].apply(seen.centre_mm)
    moved = float(np.linalg.norm(path_mm - path_mm[0], axis=1).max())
    refuted = still > max(_HELD_S, _MOST_STILL * whole)
    if moved > _MOVED_MM and (refuted or still > _LONGEST_STILL_S):
        evidence = f"expected readings that change, got the same one for {still:.2f} of {whole:.2f} s"
        yield Doubt(name_of(sensor), "frozen", evidence, refuted, runs_of(np.flatnonzero(during)))


def _turned(sensor: Sensor, turn: Rotation, centre_mm: FloatArray) -> Sensor:
    mounting = sensor.sensor_from_image
    assert mounting is not None
    if isinstance(mounting, RigidTransform):
        there = RigidTransform.from_translation(centre_mm)
        about_centre = there * RigidTransform.from_rotation(turn) * there.inv()
        return replace(sensor, sensor_from_image=mounting * about_centre)
    return replace(sensor, sensor_from_image=mounting * turn)


def _unequal_lengths(tracker: Tracker, seen: MotionEvidence, length_sigma: float) -> Iterator[Doubt]:
    scale, error = seen.elevational_scale(tracker)
    both = float(np.hypot(error, length_sigma))
    if np.isfinite(scale) and abs(scale - 1.0) > max(_UNEQUAL, _UNEQUAL_SIGMA * both):
        evidence = (
            f"expected to travel as far as the images, to {100 * both:.1f} %, got {scale:.3f} times as far"
        )
        far = max(scale, 1.0 / max(scale, 1e-9)) > _FAR_FROM_EQUAL
        yield Doubt(TRACKER, "its scale, or curves of another probe", evidence, far)


def _gravity_doubts(sensor: OrientationSensor) -> Iterator[Doubt]:
    degrees = gravity_from_vertical(sensor)
    if degrees is None or degrees <= _VERTICAL_DEG:
        return
    evidence = f"expected gravity along the world's z, got it {degrees:.0f} degrees off"
    for suspect in suspects(sensor):
        mended = gravity_from_vertical(suspect.mended)
        if mended is not None and mended < _UPRIGHT_DEG:
            yield Doubt(ORIENTATION, suspect.name, evidence, True)
            return
    yield Doubt(
        ORIENTATION, "a world whose z is not vertical, or an accelerometer on other axes", evidence, False
    )
