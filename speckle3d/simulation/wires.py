"""A wire phantom: two threads that cross in a water bath.

The medium's y axis points down; the threads lie in its plane y = 0 and cross at its origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import FloatArray
from speckle3d.simulation.bath import water_haze
from speckle3d.simulation.medium import Scatterers, TiledMedium

_SPACING_MM = 0.02
"""Between scatterers of a thread, a tenth of the shortest wavelength."""

_HALF_LENGTH_MM = 40.0

_BEARINGS_DEG = (40.0, 125.0)
"""Directions of the threads in their plane, from x towards z: a little off square, as a bench has them."""


@dataclass(frozen=True)
class CrossedThreads:
    """Two braided threads under water with a little dust.

    A braid is rough on the scale of the wavelength, so that it echoes in all directions; a smooth wire would
    be a mirror, dark wherever the beam does not meet it squarely.

    Parameters
    ----------
    haze : TiledMedium
        What drifts in the water.
    position_mm : ndarray, shape (n, 3)
        Scatterers of both threads, in the medium.
    strength : float
        Of each scatterer.
    attenuation_db_cm_mhz : float
        Of water, none.
    """

    haze: TiledMedium
    position_mm: FloatArray
    strength: float = 0.3
    attenuation_db_cm_mhz: float = 0.0

    def seen(
        self, medium_from_image: RigidTransform, low_mm: FloatArray, high_mm: FloatArray
    ) -> list[Scatterers]:
        """Haze and the parts of the threads in a box of the image."""
        place = medium_from_image.inv().apply(self.position_mm)
        near = self.position_mm[((place >= low_mm) & (place <= high_mm)).all(axis=1)]
        threads = near, np.full(len(near), self.strength, np.float32)
        return [*self.haze.seen(medium_from_image, low_mm, high_mm), threads]


def crossed_threads(entropy: int, radius_mm: float = 0.1) -> CrossedThreads:
    """Stretch two threads of `radius_mm` across each other, their scatterers at random in them."""
    rng = np.random.default_rng([entropy, 2])
    count = round(2.0 * _HALF_LENGTH_MM / _SPACING_MM)
    threads = [_thread(np.deg2rad(bearing), count, radius_mm, rng) for bearing in _BEARINGS_DEG]
    return CrossedThreads(water_haze(entropy, 30.0), np.concatenate(threads))


def _thread(bearing_rad: float, count: int, radius_mm: float, rng: np.random.Generator) -> FloatArray:
    along = np.array([np.cos(bearing_rad), 0.0, np.sin(bearing_rad)])
    across = np.array([-along[2], 0.0, along[0]])
    place = rng.uniform(-_HALF_LENGTH_MM, _HALF_LENGTH_MM, count)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, count), radius_mm * np.sqrt(rng.random(count))
    aside = np.outer(radius * np.cos(angle), across) + np.outer(radius * np.sin(angle), [0.0, 1.0, 0.0])
    return np.asarray(np.outer(place, along) + aside)
