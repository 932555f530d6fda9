"""A water bath: its floor, a bar in the middle of the beam or two threads, under water with a little dust.

The medium's y axis points down. The floor is its plane y = 0, so that the probe is at negative y; the threads
lie in that plane and cross at the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import FloatArray
from speckle3d.simulation.medium import (
    TILE_MM,
    Box,
    Layer,
    Scatterers,
    Tile,
    TiledMedium,
    tile_rng,
    tiles_near,
)
from speckle3d.simulation.settings import Reflector

_STEEPEST = np.cos(np.deg2rad(35.0))
"""Reverberations off virtual surfaces turned further than this miss the aperture."""

_SPACING_MM = 0.0625
"""Of the lattice of a sheet's scatterers; a tile's side is a multiple of it."""

_ROUGHNESS_MM = 0.01
"""Standard deviation of their heights, independent of each other.

A twentieth of the wavelength leaves a diffuse echo some 25 dB below the specular one, as of a moulded bath.
"""

_STRENGTH_PER_MM2 = 8.0
"""Echo strength of the floor. The bar's is higher, so that both are equally bright from above."""

_BAR_MM = 0.2
"""Width of the strip."""

_BEAM_MM = 0.8
"""Thickness of the focused beam: it covers this much of a wall, but only `_BAR_MM` of a bar."""

_REVERBERATION = 0.2
"""Amplitude left after sound went once more from the reflector to the probe's face and back."""

_REPEATS = 2
"""How many such echoes there are."""

_THREAD_STRENGTH = 0.3
"""Of each scatterer of a thread."""

_THREAD_RADIUS_MM = 0.1

_THREAD_SPACING_MM = 0.02
"""Between scatterers of a thread, a tenth of the shortest wavelength."""

_HALF_LENGTH_MM = 40.0

_BEARINGS_DEG = (40.0, 125.0)
"""Directions of the threads in their plane, from x towards z: a little off square, as a bench has them."""

_DUST = [Layer(-60.0, np.zeros((0, 5)), 0.02)]
"""Echo strength of what is in the water."""


@lru_cache(maxsize=200)
def _sheet(entropy: int, tile: Tile) -> FloatArray:
    """Scatterers of a rough surface in the plane y = 0 on a tile.

    They are of one sign, on a lattice, raised and lowered at random. The lattice is finer than half the
    shortest wavelength, so that the scatterers sum to a mirror where they are level, and echo in all
    directions as far as they are not: with the heights' standard deviation s and k = 2 pi / wavelength,
    exp(-(2 k s)^2) of the power is specular, the rest diffuse.
    """
    along = (np.arange(round(TILE_MM / _SPACING_MM)) + 0.5) * _SPACING_MM
    x, z = np.meshgrid(tile[0] * TILE_MM + along, tile[1] * TILE_MM + along)
    height = tile_rng(tile, entropy).normal(0.0, _ROUGHNESS_MM, x.size)
    return np.stack([x.ravel(), height, z.ravel()], axis=1)


class ImagedPlane(NamedTuple):
    """A plane in the image: ``normal @ position = offset_mm``, the normal pointing away from the probe."""

    normal: FloatArray
    offset_mm: float

    def mirrored_in(self, mirror: ImagedPlane) -> ImagedPlane:
        """Return the mirror image of this plane in another, its normal turned to point away as well."""
        along = 2.0 * float(self.normal @ mirror.normal)
        return ImagedPlane(along * mirror.normal - self.normal, along * mirror.offset_mm - self.offset_mm)

    @property
    def image_from_sheet(self) -> RigidTransform:
        """A frame on the plane: x along its line in the image, y its normal; the origin is on the line."""
        x, y, _ = self.normal
        along = np.array([y, -x, 0.0]) / np.hypot(x, y)
        axes = np.stack([along, self.normal, np.cross(along, self.normal)], axis=1)
        origin = np.array([x, y, 0.0]) * self.offset_mm / (x * x + y * y)
        return RigidTransform.from_components(origin, Rotation.from_matrix(axes))


@dataclass(frozen=True, eq=False)
class WaterBath(TiledMedium):
    """Water with a little dust, over a floor or the bar of a Cambridge phantom.

    Parameters
    ----------
    reflector : str
        wall: the whole floor. bar: a strip in the floor's plane that is only in the middle of the beam, and
        always turned towards the probe.

    References
    ----------
    .. [1] Prager et al., "Automatic calibration for 3-D free-hand ultrasound", CUED/F-INFENG/TR 303, 1997,
       sections 3.3 and 3.4.
    """

    reflector: Reflector = "wall"

    def scatterers(self, medium_from_image: RigidTransform, box: Box) -> list[Scatterers]:
        """Dust in a box of the image, the reflector, and its reverberations."""
        level = ImagedPlane(
            medium_from_image.rotation.as_matrix()[1], -float(medium_from_image.translation[1])
        )
        strength = _STRENGTH_PER_MM2 * _SPACING_MM**2
        image_from_sheet = medium_from_image.inv()
        if self.reflector == "bar":
            # Perpendicular to the image. It stays where it is: the probe sees other parts of it as it slides.
            strength *= _BEAM_MM / _BAR_MM
            flat = level.normal * [1.0, 1.0, 0.0]
            length = float(np.linalg.norm(flat))
            level = ImagedPlane(flat / length, level.offset_mm / length)
            place = medium_from_image * level.image_from_sheet
            slid = float(place.translation @ place.rotation.as_matrix()[:, 0])
            image_from_sheet = level.image_from_sheet * RigidTransform.from_translation([-slid, 0.0, 0.0])

        def sheet(image_from_sheet: RigidTransform, amplitude: float, roughness: float) -> Scatterers:
            """Scatterers of the reflector, or of its mirror image, on tiles that may reach into the box."""
            tiles = tiles_near(image_from_sheet.inv(), box)
            position = np.concatenate([_sheet(self.entropy, tile) for tile in tiles]) * [1.0, roughness, 1.0]
            if self.reflector == "bar":
                position = position[np.abs(position[:, 2]) <= _BAR_MM / 2.0]
            place = np.ascontiguousarray((medium_from_image * image_from_sheet).apply(position))
            return place, np.full(len(place), amplitude * strength, np.float32)

        sheets = [sheet(image_from_sheet, 1.0, 1.0)]
        # Virtual reflectors of the second and later round trips. Unfolding the path, the probe's face is
        # mirrored in the floor, the floor in that, and so on: from straight above these lie at twice and
        # three times the depth; elsewhere they seem turned further too.
        before = ImagedPlane(np.array([0.0, 1.0, 0.0]), 0.0)
        for count in range(1, _REPEATS + 1):
            before, level = level, before.mirrored_in(level)
            if level.normal[1] < _STEEPEST:
                break
            sheets.append(sheet(level.image_from_sheet, _REVERBERATION**count, 0.0))
        return [*super().scatterers(medium_from_image, box), *sheets]


def water_bath(entropy: int, reflector: Reflector) -> WaterBath:
    """Make a bath with a floor, or a bar in its place; the dust is 34 dB weaker than unit speckle."""
    return WaterBath(entropy, 2.0, 0.0, _DUST, depth_mm=(-60.0, 0.0), reflector=reflector)


def crossed_threads(entropy: int) -> TiledMedium:
    """Make water with two braided threads.

    A braid is rough on the scale of the wavelength, so that it echoes in all directions; a smooth wire would
    be a mirror, dark wherever the beam does not meet it squarely.
    """
    rng = np.random.default_rng([entropy, 2])
    count = round(2.0 * _HALF_LENGTH_MM / _THREAD_SPACING_MM)
    threads = []
    for bearing in np.deg2rad(_BEARINGS_DEG):
        along = np.array([np.cos(bearing), 0.0, np.sin(bearing)])
        across = np.array([-along[2], 0.0, along[0]])
        place = rng.uniform(-_HALF_LENGTH_MM, _HALF_LENGTH_MM, count)
        angle, radius = rng.uniform(0.0, 2.0 * np.pi, count), _THREAD_RADIUS_MM * np.sqrt(rng.random(count))
        aside = np.outer(radius * np.cos(angle), across) + np.outer(radius * np.sin(angle), [0.0, 1.0, 0.0])
        threads.append(np.outer(place, along) + aside)
    position = np.concatenate(threads)
    objects = [(position, np.full(len(position), _THREAD_STRENGTH, np.float32))]
    return TiledMedium(entropy, 2.0, 0.0, _DUST, depth_mm=(-60.0, 30.0), objects=objects)
