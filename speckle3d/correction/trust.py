"""Which sensors of a sweep may be believed: each is held against the images and against itself.

A stream is doubted where a fault that it may have explains what the images, its gyroscope and gravity show
far better than the stream as it is. What rests on a refuted sensor is refused; one that is doubted is used,
and the doubt goes with the results.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.errors import MismatchError
from speckle3d.core.sweep import OrientationSensor, Sweep, Tracker
from speckle3d.correction.evidence import (
    ImageEvidence,
    gravity_from_vertical,
    gyroscope_evidence,
    noise_of,
    total_misfit,
)
from speckle3d.correction.readings import Sensor, spikes, standstill, without
from speckle3d.correction.suspects import Suspect, suspects

TRACKER, ORIENTATION = "tracker", "orientation sensor"

_HELD_S, _LONGEST_STILL_S = 0.15, 0.5
"""Loggers repeat a reading until the next; beyond the second time, unchanged readings are left out."""
_MOST_STILL = 0.2
"""Share of the sweep over which readings that do not change at all refute a sensor."""
_NOISE, _MOST_NOISE = (1.5, 1.5), (10.0, 10.0)
"""Jitter of a step, mm and degrees: that of sensors in use is below 0.5 and 0.3."""
_MOST_SPIKES = 0.3
"""Share of readings; with more, there is no stream that spikes stand out of."""

# Gains in the logarithm of the likelihood. The bounds stand between good and faulty sweeps, simulated with
# small images (26 to 48 vectors): good trackers stay below 2 for every suspect, faulty ones above 10; good
# orientation sensors reach 11 by the images alone, and 0.1 by their gyroscope, faulty ones 5 to 90.
_TRACKER_GAIN = 7.0
_IMAGE_GAIN = 15.0
_GYROSCOPE_GAIN = 4.0
_CLOCK_GAIN = {TRACKER: 7.0, ORIENTATION: 10.0}
_CLOCK_RANGE_S = 1.5
_LEAST_CLOCK_S = 0.05
_LEAST_MOUNTING_DEG, _WRONG_MOUNTING_DEG = 8.0, 12.0
"""Calibrations are right to some degrees; beyond the second angle lengths and tilts are no longer."""
_PREFERENCE = 5.0
"""Any mistaken convention is also nearly some mounting; that must be this much better to be suspected."""

_UNEQUAL, _UNEQUAL_SIGMA = 0.06, 3.0
"""Elevational scale between tracker and images: images alone are right to a few per cent."""
_VERTICAL_DEG, _UPRIGHT_DEG = 25.0, 10.0
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
    """

    doubts: tuple[Doubt, ...]
    turn_confirmed: bool


def cleaned_readings(sweep: Sweep) -> tuple[Sweep, tuple[Doubt, ...]]:
    """Leave out single wild readings, and readings that stand still while the probe moves, and count them.

    Parameters
    ----------
    sweep : Sweep

    Returns
    -------
    Sweep
        With what is left of its sensors' readings; as they are where a sensor is refuted.
    tuple of Doubt
    """
    tracker, about_tracker = _cleaned(sweep.tracker, TRACKER, sweep)
    orientation, about_orientation = _cleaned(sweep.orientation, ORIENTATION, sweep)
    doubts = (*about_tracker, *about_orientation)
    return (replace(sweep, tracker=tracker, orientation=orientation) if doubts else sweep), doubts


def believed(sweep: Sweep, doubts: Iterable[Doubt]) -> Sweep:
    """The sweep without the sensors that are refuted."""
    refuted = {doubt.about for doubt in doubts if doubt.refuted}
    if not refuted & {TRACKER, ORIENTATION}:
        return sweep
    return replace(
        sweep,
        tracker=None if TRACKER in refuted else sweep.tracker,
        orientation=None if ORIENTATION in refuted else sweep.orientation,
    )


def _cleaned(sensor: Sensor | None, about: str, sweep: Sweep) -> tuple[Sensor | None, list[Doubt]]:
    if sensor is None:
        return None, []
    doubts = []
    wild = spikes(sensor)
    if wild.any():
        share = f"{int(wild.sum())} of {wild.size} readings jump away from those around them and back"
        if wild.mean() > _MOST_SPIKES:
            return sensor, [Doubt(about, "noise or scrambled values", f"expected a path, but {share}", True)]
        doubts.append(Doubt(about, "spikes", f"{share}, and are left out", False))
        sensor = without(sensor, wild)
    begin, end = standstill(sensor)
    first, last = sweep.frame_time_s[[0, -1]] - sensor.time_offset_s
    still = max(0.0, min(end, last) - max(begin, first))
    refuted = bool(still > max(_HELD_S, _MOST_STILL * (last - first)))
    if refuted or still > _LONGEST_STILL_S:
        seen = f"expected readings that change, got the same one for {still:.2f} of {last - first:.2f} s"
        doubts.append(Doubt(about, "frozen", seen, refuted))
        if not refuted:
            time_s = sensor.readings.time_s
            sensor = without(sensor, (time_s > begin) & (time_s <= end))
    return sensor, doubts


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
    seen = ImageEvidence(sweep.frame_time_s, sweep.grid.centre_mm, image)
    doubts: list[Doubt] = []
    if sweep.tracker is not None and _usable(sweep.tracker, seen):
        found = [*_Examination(TRACKER, sweep.tracker, seen).doubts()]
        doubts += found or _unequal_lengths(sweep.tracker, seen, length_sigma)
    confirmed = False
    if sweep.orientation is not None and _usable(sweep.orientation, seen):
        examination = _Examination(ORIENTATION, sweep.orientation, seen)
        found = [*examination.doubts()] or [*_gravity_doubts(sweep.orientation)]
        confirmed = examination.turn_confirmed() and not any(doubt.refuted for doubt in found)
        doubts += found
    return Trust(tuple(doubts), confirmed)


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


def _usable(sensor: OrientationSensor | Tracker, seen: ImageEvidence) -> bool:
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


class _Examination(Generic[Sensor]):
    """One sensor against the images, and against its gyroscope if it has one."""

    def __init__(self, about: str, sensor: Sensor, seen: ImageEvidence) -> None:
        self.about, self.seen = about, seen
        self.sensor: Sensor = sensor
        self.noise = noise_of(sensor, seen.time_s, seen.centre_mm)
        self.agreements = seen.agreements(sensor, self.noise)
        self.gyroscope = gyroscope_evidence(sensor) if isinstance(sensor, OrientationSensor) else None

    def doubts(self) -> Iterator[Doubt]:
        """At most one: the likeliest fault, if one is far likelier than none."""
        jitter = self.noise[[0, -1]]
        if (jitter > _NOISE).any():
            evidence = (
                f"expected a steady path, got a jitter of {jitter[0]:.2g} mm and {jitter[1]:.2g} degrees"
            )
            yield Doubt(self.about, "noise or scrambled values", evidence, bool((jitter > _MOST_NOISE).any()))
            return
        conventions = [self._gain(suspect) for suspect in suspects(self.sensor)]
        conventions.append(_Gain("another recording, or scrambled values", self._gain_of_still()))
        best = max(conventions, key=lambda gain: gain.total)
        turned, degrees = self._mounting()
        late, seconds = self._clock()
        if self._beyond(best) and best.total > max(turned.images - _PREFERENCE, late.images):
            yield Doubt(self.about, best.name, self._evidence(), True)
        elif late.images > max(_CLOCK_GAIN[self.about], turned.images):
            side = "later" if seconds > 0 else "earlier"
            evidence = f"expected motion with the images', got it {abs(seconds):.2f} s {side}"
            yield Doubt(self.about, "clock", evidence, False)
        elif self._beyond(turned) and degrees > _LEAST_MOUNTING_DEG:
            evidence = f"{self._evidence()}; turned by {degrees:.0f} degrees it would fit"
            yield Doubt(self.about, turned.name, evidence, degrees > _WRONG_MOUNTING_DEG)

    def turn_confirmed(self) -> bool:
        """Whether roll, which images know well, or the gyroscope confirm the turns that are read."""
        if self.gyroscope is not None and self.gyroscope.confirms:
            return True
        telling = [each for each in self.agreements if each.seen[-1] > 2.0 * each.noise[-1]]
        left = [(each.left[-1] / each.seen[-1]) ** 2 for each in telling]
        return bool(left) and max(left) < 1.0 - _ROLL_EXPLAINED

    def _beyond(self, gain: _Gain) -> bool:
        if self.about == TRACKER:
            return gain.images > _TRACKER_GAIN
        return gain.total > _IMAGE_GAIN or (gain.gyroscope > _GYROSCOPE_GAIN and gain.total > _GYROSCOPE_GAIN)

    def _gain(self, suspect: Suspect[Sensor]) -> _Gain:
        misfit = total_misfit(self.seen.agreements(suspect.mended, self.noise))
        turning = 0.0
        if self.gyroscope is not None and isinstance(suspect.mended, OrientationSensor):
            mended = gyroscope_evidence(suspect.mended)
            turning = 0.0 if mended is None else self.gyroscope.misfit - mended.misfit
        return _Gain(suspect.name, total_misfit(self.agreements) - misfit, turning)

    def _gain_of_still(self) -> float:
        still = self.seen.agreements(self.sensor, self.noise, still=True)
        return total_misfit(self.agreements) - total_misfit(still)

    def _mounting(self) -> tuple[_Gain, float]:
        """The rotation of the image on the sensor that fits best, and its angle, degrees."""
        best, degrees = _Gain("mounting", -np.inf), 0.0
        for sign in (1, -1):
            turn = self.seen.turn(self.sensor, self.noise, sign)
            gain = self._gain(Suspect("mounting", _turned(self.sensor, turn, self.seen.centre_mm)))
            if gain.images > best.images:
                best, degrees = gain, float(np.degrees(turn.magnitude()))
        return best, degrees

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
        seen = f"expected steps in {names[part]} as the images' ({last.seen[part]:.2f} {unit} rms) to "
        return f"{seen}{last.noise[part]:.2f} {unit}, got a difference of {last.left[part]:.2f}"


def _turned(sensor: Sensor, turn: Rotation, centre_mm: FloatArray) -> Sensor:
    mounting = sensor.sensor_from_image
    assert mounting is not None
    if isinstance(mounting, RigidTransform):
        there = RigidTransform.from_translation(centre_mm)
        about_centre = there * RigidTransform.from_rotation(turn) * there.inv()
        return replace(sensor, sensor_from_image=mounting * about_centre)
    return replace(sensor, sensor_from_image=mounting * turn)


def _unequal_lengths(tracker: Tracker, seen: ImageEvidence, length_sigma: float) -> Iterator[Doubt]:
    scale, error = seen.elevational_scale(tracker)
    both = float(np.hypot(error, length_sigma))
    if np.isfinite(scale) and abs(scale - 1.0) > max(_UNEQUAL, _UNEQUAL_SIGMA * both):
        evidence = (
            f"expected to travel as far as the images, to {100 * both:.1f} %, got {scale:.3f} times as far"
        )
        yield Doubt(TRACKER, "its scale, or curves of another probe", evidence, False)


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
