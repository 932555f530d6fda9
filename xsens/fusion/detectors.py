"""Detect magnetic disturbance and rest.

Iron near the sensor changes the two components of the field that do not depend on the heading, its horizontal
strength and its vertical part: these are compared with a reference that follows the room. A magnet that moves
with the sensor adds a vector that is constant in the sensor's axes; turning separates it from the room's
field, which is constant in the world's.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from xsens.fusion.increments import Increment
from xsens.fusion.settings import FusionSettings

SMOOTHING_S = 0.1
"""Time over which the field is smoothed: longer than its noise, shorter than a hand's pass by iron."""

UNDISTURBED_AFTER_S = 0.5
"""A field is trusted again when it has fitted for this time (VQF's default)."""

TURNING_RAD_S = math.radians(20.0)
"""A new reference is learnt only while the sensor turns faster (VQF's default)..."""

LEARNT_AFTER_S = 10.0
"""...and only after turning for this time."""

STARTING_S = 1.0
"""The first reference is the mean field over this time."""

IRON_MEMORY_S = 60.0
"""Time over which the estimate of iron, once learnt, is refined."""

PROVED_AFTER_S = 20.0
"""A first reference that has fitted for this time of turning is confirmed as the room's."""

IRON_PRIOR = 0.01
"""Variance of the field's unevenness over that of unknown iron: 3 microtesla against 30."""

UNEVEN = 0.15
"""Largest residual of a reference, as a fraction of the field's norm: that of a room with iron in it."""

FIRST_AFTER_S, FIRST_UNEVEN = 5.0, 0.5
"""The same while the first reference is not confirmed, which may have been learnt beside iron (5 s: VQF's
default): even a poor reference is then better."""

STEEPEST = 0.05
"""A field with a smaller horizontal fraction shows no heading: iron in the room turns it to any side."""

REST_MEMORY_S = 0.5
"""Time over which a resting sensor's readings are averaged."""

BETTER = 2.0
"""Factor by which a new reference must reduce the variance left by the one it replaces."""


@dataclass(frozen=True)
class Reference:
    """The room's field, and the field of iron that moves with the sensor.

    Attributes
    ----------
    horizontal_au, vertical_au : float
        The room's field; vertical is up.
    iron_au : ndarray, shape (3,)
        Field of iron that moves with the sensor, in the sensor's axes.
    """

    horizontal_au: float
    vertical_au: float
    iron_au: FloatArray

    @property
    def norm_au(self) -> float:
        """Strength of the room's field."""
        return math.hypot(self.horizontal_au, self.vertical_au)

    @property
    def dip_rad(self) -> float:
        """Angle of the room's field below the horizon."""
        return math.atan2(-self.vertical_au, self.horizontal_au)

    def fits(self, horizontal: float, vertical: float, settings: FusionSettings) -> bool:
        """Whether a field, iron removed, has the reference's norm and dip."""
        norm = math.hypot(horizontal, vertical)
        dip = math.atan2(-vertical, horizontal)
        return (
            abs(norm - self.norm_au) <= settings.norm_tolerance * self.norm_au
            and abs(dip - self.dip_rad) <= settings.dip_tolerance_rad
        )

    def towards(self, horizontal: float, vertical: float, share: float) -> Reference:
        """The reference moved by `share` of the way to a field."""
        return Reference(
            self.horizontal_au + share * (horizontal - self.horizontal_au),
            self.vertical_au + share * (vertical - self.vertical_au),
            self.iron_au,
        )


class _Candidate:
    """Least squares of a room's field and iron over readings while turning; old readings fade.

    Both have a closed form in four means: of the rotation R (world from sensor), of the field in the sensor's
    axes m and in the world's u = R m, and of the square of its norm.
    """

    def __init__(self, memory_s: float) -> None:
        self.memory_s = memory_s
        self.clear()

    def clear(self) -> None:
        self.weight_s = self._square = self._misfit = 0.0
        self._turn, self._body, self._world = np.zeros((3, 3)), np.zeros(3), np.zeros(3)

    def add(
        self, world_from_sensor: FloatArray, world_field: FloatArray, misfit: float, duration_s: float
    ) -> None:
        keep = math.exp(-duration_s / self.memory_s)
        self.weight_s = keep * self.weight_s + duration_s
        self._turn = keep * self._turn + duration_s * world_from_sensor
        self._body = keep * self._body + duration_s * (world_field @ world_from_sensor)
        self._world = keep * self._world + duration_s * world_field
        self._square = keep * self._square + duration_s * float(world_field @ world_field)
        self._misfit = keep * self._misfit + duration_s * misfit

    def solve(self) -> tuple[FloatArray, FloatArray, float]:
        """The room's field in the world's axes, iron in the sensor's, and the mean square residual."""
        turn, body, world = (a / self.weight_s for a in (self._turn, self._body, self._world))
        iron = np.linalg.solve((1.0 + IRON_PRIOR) * np.eye(3) - turn.T @ turn, body - turn.T @ world)
        room = world - turn @ iron
        left = self._square / self.weight_s - room @ room - iron @ iron - 2.0 * room @ turn @ iron
        return room, np.asarray(iron, dtype=np.float64), max(float(left), 0.0)

    def room_with(self, iron: FloatArray) -> tuple[FloatArray, float]:
        """The room's field for a given iron, and the mean square residual."""
        turn, body, world = (a / self.weight_s for a in (self._turn, self._body, self._world))
        room = world - turn @ iron
        square = self._square / self.weight_s - 2.0 * iron @ body + iron @ iron
        return room, max(float(square - room @ room), 0.0)

    def better_than(self, reference: Reference, proved: bool) -> tuple[FloatArray, FloatArray] | None:
        """Room and iron if they are known well enough and clearly better than the reference in use.

        The iron is kept if another room alone explains the readings nearly as well.
        """
        after_s, uneven = (LEARNT_AFTER_S, UNEVEN) if proved else (FIRST_AFTER_S, FIRST_UNEVEN)
        if self.weight_s < after_s:
            return None
        room, iron, left = self.solve()
        if left > (uneven * np.linalg.norm(room)) ** 2:
            return None
        if 1.5 * self._misfit / self.weight_s < BETTER * left:  # the misfit is of two components of three
            return None
        other, same_iron = self.room_with(reference.iron_au)
        return (other, reference.iron_au) if same_iron < BETTER * left else (room, iron)


@dataclass(frozen=True)
class FieldReading:
    """Judgement of one reading of the field.

    Attributes
    ----------
    world_au : ndarray, shape (3,)
        The field without iron, in the world's axes.
    disturbed : bool
    variance_rad2 : float
        Variance of its heading, estimated from the error of the two other components; without the room's own
        unevenness.
    restart_au : ndarray, shape (3,), or None
        The room's field, if it has just replaced a first reference that was not confirmed: the heading may be
        far off.
    """

    world_au: FloatArray
    disturbed: bool
    variance_rad2: float
    restart_au: FloatArray | None


class FieldMonitor:
    """Judge readings of the field one after the other."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._candidate = _Candidate(settings.field_memory_s)
        self._known: _Candidate | None = None
        self.reference: Reference | None = None
        self.confirmed = False
        self._fitting_s = UNDISTURBED_AFTER_S
        self._age_s = self._turned_s = 0.0
        self._horizontal = self._vertical = 0.0

    def read(
        self, world_from_sensor: FloatArray, field_au: FloatArray, rate_rad_s: float, duration_s: float
    ) -> FieldReading:
        """Judge the mean field of a block.

        Parameters
        ----------
        world_from_sensor : ndarray, shape (3, 3)
            In the middle of the block, in any world whose z is up and whose heading drifts slowly.
        field_au : ndarray, shape (3,)
            In that world.
        rate_rad_s : float
            Rate of turn of the sensor.
        duration_s : float
        """
        reference = self.reference or Reference(math.hypot(*field_au[:2]), float(field_au[2]), np.zeros(3))
        clean = field_au - world_from_sensor @ reference.iron_au
        self._smooth(clean, duration_s)
        fits = reference.fits(self._horizontal, self._vertical, self._settings)
        self._fitting_s = self._fitting_s + duration_s if fits else 0.0
        across, along = self._horizontal - reference.horizontal_au, self._vertical - reference.vertical_au
        off = across**2 + along**2
        self.reference = self._followed(reference, duration_s)
        restart = None
        if rate_rad_s > TURNING_RAD_S:
            self._turned_s += duration_s if fits else 0.0
            self._candidate.add(world_from_sensor, field_au, off, duration_s)
            if fits and self._known is not None:
                self._known.add(world_from_sensor, field_au, off, duration_s)
                room, iron, _ = self._known.solve()
                self.reference = Reference(math.hypot(room[0], room[1]), float(room[2]), iron)
            learnt = self._learn()
            restart = None if self.confirmed else learnt
            self.confirmed = self.confirmed or self._turned_s > PROVED_AFTER_S
        steep = reference.horizontal_au <= STEEPEST * reference.norm_au
        disturbed = steep or self._fitting_s < UNDISTURBED_AFTER_S
        variance = math.inf if steep else off / (2.0 * reference.horizontal_au**2)
        return FieldReading(clean, disturbed, variance, restart)

    def _smooth(self, clean: FloatArray, duration_s: float) -> None:
        horizontal, vertical = math.hypot(clean[0], clean[1]), float(clean[2])
        share = 1.0 - math.exp(-duration_s / SMOOTHING_S) if self._age_s else 1.0
        self._horizontal += share * (horizontal - self._horizontal)
        self._vertical += share * (vertical - self._vertical)
        self._age_s += duration_s

    def _followed(self, reference: Reference, duration_s: float) -> Reference:
        """The reference moved a little towards the present field, if that fits."""
        if self._age_s <= STARTING_S:
            return reference.towards(self._horizontal, self._vertical, duration_s / self._age_s)
        if self._fitting_s < UNDISTURBED_AFTER_S:
            return reference
        share = duration_s / self._settings.field_memory_s
        return reference.towards(self._horizontal, self._vertical, share)

    def _learn(self) -> FloatArray | None:
        """Replace the reference if another fits clearly better; return the room's field of the new one."""
        assert self.reference is not None
        better = self._candidate.better_than(self.reference, self.confirmed)
        if better is None:
            return None
        room, iron = better
        if iron is not self.reference.iron_au:
            self._known = copy(self._candidate)
            self._known.memory_s = IRON_MEMORY_S
        self.reference = Reference(math.hypot(room[0], room[1]), float(room[2]), iron)
        self._candidate.clear()
        self._fitting_s = self._turned_s = 0.0
        return room


class RestDetector:
    """Detect rest: gyroscope and accelerometer stay near their means of the last half second for a while."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._rate: FloatArray | None = None
        self._force = np.zeros(3)
        self._still_s = 0.0

    def rests(self, increment: Increment, bias_rad_s: FloatArray, bias_sd_rad_s: float) -> bool:
        """Whether the sensor rests, given the bias and its standard deviation."""
        force = increment.velocity_m_s / increment.duration_s
        if self._rate is None:
            self._rate, self._force = increment.rate_rad_s.copy(), force
        rate_off, force_off = increment.rate_rad_s - self._rate, force - self._force
        share = increment.duration_s / (REST_MEMORY_S + increment.duration_s)
        self._rate += share * rate_off
        self._force = self._force + share * force_off
        limit = self._settings.rest_bias_rad_s + 3.0 * bias_sd_rad_s
        still = (
            math.hypot(*rate_off) < self._settings.rest_rate_rad_s
            and math.hypot(*force_off) < self._settings.rest_force_m_s2
            and math.hypot(*(self._rate - bias_rad_s)) < limit
        )
        self._still_s = self._still_s + increment.duration_s if still else 0.0
        return self._still_s > self._settings.rest_after_s
