"""A water bath: its floor, or a bar in the middle of the beam, under water with a little dust.

The medium's y axis points down and the floor is its plane y = 0, so that the probe is at negative y.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.simulation.medium import Layer, Scatterers, TiledMedium, Waves, bounds_in_medium
from speckle3d.simulation.tiles import Tiles, tile_seed

Reflector = Literal["wall", "bar"]

_KEPT_TILES = 200
"""An image meets the floor in about 40 tiles; the rest serve the frames around it."""

_STEEPEST = np.cos(np.deg2rad(35.0))
"""Reverberations off virtual surfaces turned further than this miss the aperture."""


@dataclass(frozen=True)
class RoughSheet:
    """A surface in the plane y = 0: scatterers of one sign on a lattice, raised and lowered at random.

    The lattice is finer than half the shortest wavelength, so that the scatterers sum to a mirror where they
    are level, and echo in all directions as far as they are not: with the heights' standard deviation
    s and k = 2 pi / wavelength, exp(-(2 k s)^2) of the power is specular, the rest diffuse.

    Parameters
    ----------
    entropy : int
        Seed; with a tile's indices it determines the tile.
    spacing_mm : float
        Of the lattice; a tile's side is a multiple of it.
    roughness_mm : float
        Standard deviation of the heights, independent of each other. A twentieth of the wavelength leaves a
        diffuse echo some 25 dB below the specular one, as of a moulded bath.
    """

    entropy: int
    spacing_mm: float = 0.0625
    roughness_mm: float = 0.01
    tile_mm: float = 4.0

    @cached_property
    def tiles(self) -> Tiles[FloatArray]:
        """Positions of the scatterers on tiles whose first corners are at i, j tiles, shape (n, 3) each."""
        return Tiles(self._make, _KEPT_TILES)

    def _make(self, i: int, j: int) -> FloatArray:
        rng = np.random.default_rng([self.entropy, *tile_seed(i, j)])
        along = (np.arange(round(self.tile_mm / self.spacing_mm)) + 0.5) * self.spacing_mm
        x, z = np.meshgrid(i * self.tile_mm + along, j * self.tile_mm + along)
        return np.stack([x.ravel(), rng.normal(0.0, self.roughness_mm, x.size), z.ravel()], axis=1)

    def near(self, image_from_sheet: RigidTransform, low_mm: FloatArray, high_mm: FloatArray) -> FloatArray:
        """Positions, in the sheet, on all tiles that may reach into a box of the image, shape (n, 3)."""
        low, high = bounds_in_medium(image_from_sheet.inv(), low_mm, high_mm)
        first = np.floor(low[[0, 2]] / self.tile_mm).astype(int)
        last = np.floor(high[[0, 2]] / self.tile_mm).astype(int)
        tiles = np.indices(last - first + 1).reshape(2, -1).T + first
        middle = np.insert((tiles + 0.5) * self.tile_mm, 1, 0.0, axis=1)
        place, corner = image_from_sheet.apply(middle), self.tile_mm / np.sqrt(2.0)
        reached = ((place >= low_mm - corner) & (place <= high_mm + corner)).all(axis=1)
        found = self.tiles(tiles[reached])
        return np.concatenate(found) if found else np.empty((0, 3))


@dataclass(frozen=True)
class Level:
    """A plane in the image: ``normal @ position = offset_mm``, the normal pointing away from the probe."""

    normal: FloatArray
    offset_mm: float

    @classmethod
    def floor(cls, medium_from_image: RigidTransform) -> Level:
        """Where the floor is in an image."""
        normal = medium_from_image.rotation.as_matrix()[1]
        return cls(normal, -float(medium_from_image.translation[1]))

    def mirrored_in(self, mirror: Level) -> Level:
        """Return the mirror image of this plane in another, its normal turned to point away as well."""
        along = float(self.normal @ mirror.normal)
        return Level(
            2.0 * along * mirror.normal - self.normal, 2.0 * along * mirror.offset_mm - self.offset_mm
        )

    def facing(self) -> Level:
        """Return the plane through the same line of the image that is perpendicular to the image."""
        flat = self.normal * [1.0, 1.0, 0.0]
        length = float(np.linalg.norm(flat))
        return Level(flat / length, self.offset_mm / length)

    @property
    def image_from_sheet(self) -> RigidTransform:
        """A frame on the plane: x along its line in the image, y its normal; the origin is on the line."""
        x, y, _ = self.normal
        along = np.array([y, -x, 0.0]) / np.hypot(x, y)
        axes = np.stack([along, self.normal, np.cross(along, self.normal)], axis=1)
        origin = np.array([x, y, 0.0]) * self.offset_mm / (x * x + y * y)
        return RigidTransform.from_components(origin, Rotation.from_matrix(axes))


@dataclass(frozen=True)
class WaterBath:
    """A medium whose reflector is a floor, or the bar of a Cambridge phantom.

    Parameters
    ----------
    haze : TiledMedium
        What drifts in the water above the floor.
    sheet : RoughSheet
        The reflector's surface.
    reflector : str
        wall: the whole floor. bar: a strip in the floor's plane that is only in the middle of the beam, and
        always turned towards the probe.
    strength_per_mm2 : float
        Echo strength of the floor. The bar's is higher, so that both are equally bright from above.
    bar_mm : float
        Width of the strip.
    reverberation : float
        Amplitude left after sound went once more from the reflector to the probe's face and back.
    repeats : int
        How many such echoes there are.

    References
    ----------
    .. [1] Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997,
       sections 3.3 and 3.4.
    """

    haze: TiledMedium
    sheet: RoughSheet
    reflector: Reflector = "wall"
    strength_per_mm2: float = 8.0
    bar_mm: float = 0.2
    reverberation: float = 0.2
    repeats: int = 2
    attenuation_db_cm_mhz: float = 0.0

    def seen(
        self, medium_from_image: RigidTransform, low_mm: FloatArray, high_mm: FloatArray
    ) -> list[Scatterers]:
        """Reflector, its reverberations and the haze in a box of the image."""
        blocks = self.haze.seen(medium_from_image, low_mm, high_mm)
        floor = Level.floor(medium_from_image)
        if self.reflector == "wall":
            floor_from_sheet = medium_from_image.inv()
            blocks.append(self._scatterers(self.sheet.near(floor_from_sheet, low_mm, high_mm)))
        else:
            floor = floor.facing()
            blocks.append(self._bar(floor, medium_from_image, low_mm, high_mm))
        for level, amplitude in self._reverberations(floor):
            position = self._strip(self.sheet.near(level.image_from_sheet, low_mm, high_mm))
            position[:, 1] = 0.0
            place = medium_from_image * level.image_from_sheet
            blocks.append(self._scatterers(place.apply(position), amplitude))
        return blocks

    def _bar(
        self, line: Level, medium_from_image: RigidTransform, low_mm: FloatArray, high_mm: FloatArray
    ) -> Scatterers:
        image_from_line = line.image_from_sheet
        # The bar stays where it is: the probe sees other parts of it as it slides over it.
        place = medium_from_image * image_from_line
        slid = float(place.translation @ place.rotation.as_matrix()[:, 0])
        image_from_bar = image_from_line * RigidTransform.from_translation([-slid, 0.0, 0.0])
        position = self._strip(self.sheet.near(image_from_bar, low_mm, high_mm))
        return self._scatterers((medium_from_image * image_from_bar).apply(position))

    def _strip(self, position: FloatArray) -> FloatArray:
        """Those of the sheet's scatterers that the reflector has."""
        if self.reflector == "wall":
            return position
        return position[np.abs(position[:, 2]) <= self.bar_mm / 2.0]

    def _reverberations(self, floor: Level) -> Iterator[tuple[Level, float]]:
        """Virtual reflectors of the second and later round trips, with their amplitudes.

        Unfolding the path, the probe's face is mirrored in the floor, the floor in that, and so on: from
        straight above these lie at twice and three times the depth; elsewhere they seem turned further too.
        """
        before, level = Level(np.array([0.0, 1.0, 0.0]), 0.0), floor
        for count in range(1, self.repeats + 1):
            before, level = level, before.mirrored_in(level)
            if level.normal[1] < _STEEPEST:
                return
            yield level, self.reverberation**count

    def _scatterers(self, position: FloatArray, amplitude: float = 1.0) -> Scatterers:
        each = amplitude * self.strength_per_mm2 * self.sheet.spacing_mm**2
        if self.reflector == "bar":
            each *= _BEAM_MM / self.bar_mm
        return position, np.full(len(position), each, np.float32)


_BEAM_MM = 0.8
"""Thickness of the focused beam: it covers this much of a wall, but only `bar_mm` of a bar."""


def water_haze(entropy: int, down_to_mm: float = 0.0) -> TiledMedium:
    """Make a little dust in water, 34 dB weaker than speckle of unit strength."""
    still = Waves(np.zeros((0, 5)))
    return TiledMedium(entropy, 2.0, 0.0, [Layer(-60.0, still, 0.02)], depth_mm=(-60.0, down_to_mm))


def water_bath(entropy: int, reflector: Reflector) -> WaterBath:
    """Make a bath with a little dust in its water."""
    return WaterBath(water_haze(entropy), RoughSheet(entropy), reflector)
