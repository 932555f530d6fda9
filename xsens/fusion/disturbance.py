"""Whether the magnetic field can be trusted for heading: its norm and dip against a changing reference.

Iron near the sensor shows in the two components of the field that do not depend on the heading, its
horizontal strength and its vertical part. A magnet that moves with the sensor adds a vector that is
constant in the sensor's axes; turning tells it from the room's field, which is constant in the world's.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import FloatArray
from xsens.fusion.settings import FusionSettings

_SMOOTHING_S = 0.1
"""The field is judged after smoothing so long: longer than its noise, shorter than a hand's pass by iron."""

_UNDISTURBED_AFTER_S = 0.5
"""A field is trusted again when it has fitted for so long (VQF's default)."""

_TURNING_RAD_S = math.radians(20.0)
"""Only a sensor that turns faster learns a new reference (VQF's default)."""

_LEARNT_AFTER_S = 10.0
"""...and only after turning so long."""

_STARTING_S = 1.0
"""The first reference is the mean field of so long."""

_IRON_MEMORY_S = 60.0
"""Iron once learnt is refined by what was seen over so long."""

_PROVED_AFTER_S = 20.0
"""A first reference that has fitted while turning so long is the room's."""

_IRON_PRIOR = 0.01
"""Variance of the field's unevenness over that of unknown iron: 3 microtesla against 30."""

_UNEVEN = 0.15
"""What a reference may leave of the field's norm: that of a room with iron in it."""

_FIRST_AFTER_S, _FIRST_UNEVEN = 5.0, 0.5
"""The same for a first reference that has not proved itself, which was perhaps learnt beside iron (5 s: VQF's
default): what would be a poor reference is better than none."""

_STEEPEST = 0.05
"""A field with less of its strength across shows no heading: a room's iron turns it any way."""

_BETTER = 2.0
"""A new reference must leave so much less variance than the one it replaces."""


@dataclass(frozen=True)
class Reference:
    """The room's field, and what moves with the sensor.

    Attributes
    ----------
    horizontal_au, vertical_au : float
        The room's field; vertical is up.
    iron_au : ndarray, shape (3,)
        Field of what moves with the sensor, in its axes.
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
        """How far the room's field points below the horizon."""
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
    """Least squares of a room's field and iron over what was seen while turning, old readings forgotten.

    Both follow from four means in closed form: of the rotation R (world from sensor), of the field in the
    sensor's axes m and in the world's u = R m, and of their square.
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
        """The room's field in the world's axes, iron in the sensor's, and the mean square they leave."""
        turn, body, world = (a / self.weight_s for a in (self._turn, self._body, self._world))
        iron = np.linalg.solve((1.0 + _IRON_PRIOR) * np.eye(3) - turn.T @ turn, body - turn.T @ world)
        room = world - turn @ iron
        left = self._square / self.weight_s - room @ room - iron @ iron - 2.0 * room @ turn @ iron
        return room, np.asarray(iron, dtype=np.float64), max(float(left), 0.0)

    def room_with(self, iron: FloatArray) -> tuple[FloatArray, float]:
        """The room's field if the iron is as given, and the mean square that leaves."""
        turn, body, world = (a / self.weight_s for a in (self._turn, self._body, self._world))
        room = world - turn @ iron
        square = self._square / self.weight_s - 2.0 * iron @ body + iron @ iron
        return room, max(float(square - room @ room), 0.0)

    def better_than(self, reference: Reference, proved: bool) -> tuple[FloatArray, FloatArray] | None:
        """Room and iron if known well enough and clearly better than the reference in use.

        The iron stays what it was if another room alone explains nearly as much.
        """
        after_s, uneven = (_LEARNT_AFTER_S, _UNEVEN) if proved else (_FIRST_AFTER_S, _FIRST_UNEVEN)
        if self.weight_s < after_s:
            return None
        room, iron, left = self.solve()
        if left > (uneven * np.linalg.norm(room)) ** 2:
            return None
        if 1.5 * self._misfit / self.weight_s < _BETTER * left:  # it is of two components of three
            return None
        other, same_iron = self.room_with(reference.iron_au)
        return (other, reference.iron_au) if same_iron < _BETTER * left else (room, iron)


@dataclass(frozen=True)
class FieldReading:
    """One reading of the field, judged.

    Attributes
    ----------
    world_au : ndarray, shape (3,)
        Iron removed, in the axes given.
    disturbed : bool
    variance_rad2 : float
        Of the heading it shows, by how far the two other components are off; without the room's own
        unevenness.
    restart_au : ndarray, shape (3,), or None
        The room's field, when it replaced a first reference that had not proved itself: the heading may be
        far off.
    """

    world_au: FloatArray
    disturbed: bool
    variance_rad2: float
    restart_au: FloatArray | None


class FieldMonitor:
    """Judges readings of the field, one after the other."""

    def __init__(self, settings: FusionSettings) -> None:
        self._settings = settings
        self._candidate = _Candidate(settings.field_memory_s)
        self._known: _Candidate | None = None
        self.reference: Reference | None = None
        self.confirmed = False
        self._fitting_s = _UNDISTURBED_AFTER_S
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
            How fast the sensor turned.
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
        if rate_rad_s > _TURNING_RAD_S:
            self._turned_s += duration_s if fits else 0.0
            self._candidate.add(world_from_sensor, field_au, off, duration_s)
            if fits and self._known is not None:
                self._known.add(world_from_sensor, field_au, off, duration_s)
                self._refine()
            learnt = self._learn()
            restart = None if self.confirmed else learnt
            self.confirmed = self.confirmed or self._turned_s > _PROVED_AFTER_S
        steep = reference.horizontal_au <= _STEEPEST * reference.norm_au
        disturbed = steep or self._fitting_s < _UNDISTURBED_AFTER_S
        variance = math.inf if steep else off / (2.0 * reference.horizontal_au**2)
        return FieldReading(clean, disturbed, variance, restart)

    def _smooth(self, clean: FloatArray, duration_s: float) -> None:
        horizontal, vertical = math.hypot(clean[0], clean[1]), float(clean[2])
        share = 1.0 - math.exp(-duration_s / _SMOOTHING_S) if self._age_s else 1.0
        self._horizontal += share * (horizontal - self._horizontal)
        self._vertical += share * (vertical - self._vertical)
        self._age_s += duration_s

    def _followed(self, reference: Reference, duration_s: float) -> Reference:
        """The reference, a little nearer to the field of now if that fits."""
        if self._age_s <= _STARTING_S:
            return reference.towards(self._horizontal, self._vertical, duration_s / self._age_s)
        if self._fitting_s < _UNDISTURBED_AFTER_S:
            return reference
        share = duration_s / self._settings.field_memory_s
        return reference.towards(self._horizontal, self._vertical, share)

    def _learn(self) -> FloatArray | None:
        """The room's field, if turning showed another reference to fit clearly better."""
        assert self.reference is not None
        better = self._candidate.better_than(self.reference, self.confirmed)
        if better is None:
            return None
        room, iron = better
        if iron is not self.reference.iron_au:
            self._known = copy(self._candidate)
            self._known.memory_s = _IRON_MEMORY_S
        self.reference = Reference(math.hypot(room[0], room[1]), float(room[2]), iron)
        self._candidate.clear()
        self._fitting_s = self._turned_s = 0.0
        return room

    def _refine(self) -> None:
        """Iron once learnt is known better the longer the sensor turns."""
        if self._known is None:
            return
        room, iron, _ = self._known.solve()
        self.reference = Reference(math.hypot(room[0], room[1]), float(room[2]), iron)
