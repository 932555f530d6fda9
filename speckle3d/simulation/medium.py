"""What is scanned: point scatterers in a medium frame whose axes are lateral, depth and along the sweep.

Media are made tile by tile as the beam reaches them, each tile from its own seed, so that a sweep of any
length needs the memory of its neighbourhood only and the same seed always gives the same scatterers.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from speckle3d.core.geometry import FloatArray

Scatterers = tuple[FloatArray, npt.NDArray[np.float32]]
"""Positions, shape (n, 3), mm, and strengths, shape (n,): unit strength at 1 per mm^3 is the reference."""

_KEPT_TILES = 160


class Medium(Protocol):
    """Anything that can list its scatterers in a box."""

    attenuation_db_cm_mhz: float

    def within(self, low_mm: FloatArray, high_mm: FloatArray) -> list[Scatterers]:
        """Blocks of scatterers that together hold all those between the corners, and perhaps more."""


@dataclass(frozen=True)
class PointMedium:
    """Scatterers listed one by one."""

    position_mm: FloatArray
    strength: npt.NDArray[np.float32]
    attenuation_db_cm_mhz: float = 0.0

    def within(self, low_mm: FloatArray, high_mm: FloatArray) -> list[Scatterers]:
        """All of them: there are few."""
        return [(self.position_mm, self.strength)]


@dataclass(frozen=True)
class Sphere:
    """A ball in which the background's echo strength is multiplied by `factor` (0: an anechoic cyst)."""

    centre_mm: tuple[float, float, float]
    radius_mm: float
    factor: float


@dataclass(frozen=True)
class Sheet:
    """A thin undulating reflector across the whole medium, such as fascia.

    ``waves`` holds one row per sinusoid: amplitude (mm), wave number along x and z (rad/mm), phase (rad).
    """

    depth_mm: float
    waves: FloatArray
    strength: float
    per_mm2: float = 60.0
    thickness_mm: float = 0.015

    def depth_at(self, x_mm: FloatArray, z_mm: FloatArray) -> FloatArray:
        """Depth of the sheet."""
        phase = np.multiply.outer(x_mm, self.waves[:, 1]) + np.multiply.outer(z_mm, self.waves[:, 2])
        return np.asarray(self.depth_mm + np.sin(phase + self.waves[:, 3]) @ self.waves[:, 0])


@dataclass(frozen=True)
class Clusters:
    """Neyman-Scott clusters, round or drawn out into fibres: parents at random, children about them.

    Parameters
    ----------
    per_mm3, children, strength : float
        Density of parents, children of each, and a child's strength.
    length_mm : float
        Mean length of a fibre, exponentially distributed up to three times this; zero for round clusters.
    spread_mm : float
        Standard deviation of children across the fibre, or in all directions.
    direction : tuple of float
        Fibres' mean direction in the medium; `wander_rad` is their scatter about it.
    coherent : bool
        Whether the children of one parent share one sign.
    """

    per_mm3: float
    children: int
    strength: float
    length_mm: float = 0.0
    spread_mm: float = 0.1
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    wander_rad: float = 0.05
    coherent: bool = True

    @property
    def reach_mm(self) -> float:
        """How far a child may lie from its parent."""
        return 1.5 * self.length_mm + 3.0 * self.spread_mm


@dataclass(frozen=True)
class DepthBand:
    """Echo strength of the diffuse background between two depths; `fill` is the part of scatterers kept."""

    from_mm: float
    to_mm: float
    strength: float
    fill: float = 1.0


@dataclass(frozen=True)
class TiledMedium:
    """An unbounded slab of tissue, made on demand in square columns.

    Parameters
    ----------
    entropy : int
        Seed; with a tile's index it determines the tile.
    per_mm3 : float
        Density of the diffuse background.
    bands, spheres, sheets, clusters
        Later bands and spheres overrule or multiply earlier ones; clusters respect anechoic spheres.
    depth_mm : tuple of float
        The slab, from a little above the skin so that a probe may move up.
    """

    entropy: int
    per_mm3: float
    attenuation_db_cm_mhz: float = 0.0
    bands: Sequence[DepthBand] = ()
    spheres: Sequence[Sphere] = ()
    sheets: Sequence[Sheet] = ()
    clusters: Sequence[Clusters] = ()
    depth_mm: tuple[float, float] = (-3.0, 50.0)
    tile_mm: float = 4.0
    _tiles: OrderedDict[tuple[int, int], Scatterers] = field(
        default_factory=OrderedDict, repr=False, compare=False
    )

    def within(self, low_mm: FloatArray, high_mm: FloatArray) -> list[Scatterers]:
        """Blocks of scatterers that together hold all those between the corners."""
        reach = max((c.reach_mm for c in self.clusters), default=0.0)
        first = np.floor((low_mm[[0, 2]] - reach) / self.tile_mm).astype(int)
        last = np.floor((high_mm[[0, 2]] + reach) / self.tile_mm).astype(int)
        return [self._tile(i, j) for i in range(first[0], last[0] + 1) for j in range(first[1], last[1] + 1)]

    def _tile(self, i: int, j: int) -> Scatterers:
        if (i, j) not in self._tiles:
            while len(self._tiles) >= _KEPT_TILES:
                self._tiles.popitem(last=False)
            self._tiles[i, j] = self._make(i, j)
        self._tiles.move_to_end((i, j))
        return self._tiles[i, j]

    def _make(self, i: int, j: int) -> Scatterers:
        # Entropy takes no negative numbers; tiles on either side of the origin need distinct ones.
        rng = np.random.default_rng([self.entropy, i % 2**32, j % 2**32])
        corner = np.array([i * self.tile_mm, self.depth_mm[0], j * self.tile_mm])
        size = np.array([self.tile_mm, self.depth_mm[1] - self.depth_mm[0], self.tile_mm])
        parts = [self._background(rng, corner, size)]
        parts += [self._sheet(rng, sheet, corner, size) for sheet in self.sheets]
        parts += [self._cluster(rng, cluster, corner, size) for cluster in self.clusters]
        position = np.concatenate([p for p, _ in parts])
        strength = np.concatenate([s for _, s in parts])
        kept = strength != 0.0
        return position[kept], strength[kept].astype(np.float32)

    def _background(self, rng: np.random.Generator, corner: FloatArray, size: FloatArray) -> Scatterers:
        n = rng.poisson(self.per_mm3 * size.prod())
        position = corner + rng.random((n, 3)) * size
        strength, fill = np.ones(n), np.ones(n)
        for band in self.bands:
            inside = (position[:, 1] >= band.from_mm) & (position[:, 1] < band.to_mm)
            strength[inside], fill[inside] = band.strength, band.fill
        # Equal strengths of random sign give fully developed speckle with the fewest scatterers.
        sign = rng.choice([-1.0, 1.0], n) / np.sqrt(self.per_mm3)
        return position, self._through_spheres(position, strength * sign) * (rng.random(n) < fill)

    def _through_spheres(self, position: FloatArray, strength: FloatArray) -> FloatArray:
        for sphere in self.spheres:
            r2 = ((position - sphere.centre_mm) ** 2).sum(axis=1)
            strength = np.where(r2 < sphere.radius_mm**2, strength * sphere.factor, strength)
        return strength

    def _sheet(
        self, rng: np.random.Generator, sheet: Sheet, corner: FloatArray, size: FloatArray
    ) -> Scatterers:
        n = rng.poisson(sheet.per_mm2 * size[0] * size[2])
        position = corner + rng.random((n, 3)) * size
        depth = sheet.depth_at(position[:, 0], position[:, 2])
        position[:, 1] = depth + sheet.thickness_mm * rng.standard_normal(n)
        return position, self._through_spheres(position, np.full(n, sheet.strength / sheet.per_mm2))

    def _cluster(
        self, rng: np.random.Generator, kind: Clusters, corner: FloatArray, size: FloatArray
    ) -> Scatterers:
        n = rng.poisson(kind.per_mm3 * size.prod())
        parent = corner + rng.random((n, 3)) * size
        along = np.minimum(rng.exponential(1.0, n), 3.0) * kind.length_mm
        axis = np.asarray(kind.direction) + kind.wander_rad * rng.standard_normal((n, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        offset = (rng.random((n, kind.children)) - 0.5) * along[:, None]
        child = parent[:, None] + offset[..., None] * axis[:, None]
        across = np.clip(rng.standard_normal(child.shape), -3.0, 3.0) * kind.spread_mm
        signs = rng.choice([-1.0, 1.0], (n, 1 if kind.coherent else kind.children))
        strength = np.broadcast_to(signs * kind.strength, (n, kind.children)).ravel()
        position = (child + across).reshape(-1, 3)
        return position, self._through_spheres(position, strength)


def fully_developed(entropy: int, per_mm3: float = 60.0, attenuation_db_cm_mhz: float = 0.3) -> TiledMedium:
    """A uniform speckle phantom."""
    return TiledMedium(entropy, per_mm3, attenuation_db_cm_mhz)


def phantom(entropy: int, per_mm3: float = 60.0) -> TiledMedium:
    """A speckle phantom with a few spherical inclusions, brighter and darker by 6 to 12 dB."""
    rng = np.random.default_rng([entropy, 1])
    factors = (2.0, 0.5, 0.25, 3.0, 0.5)
    spheres = [
        Sphere((float(rng.uniform(4, 34)), float(rng.uniform(8, 34)), float(rng.uniform(0, 20))), 3.0, f)
        for f in factors
    ]
    return TiledMedium(entropy, per_mm3, 0.3, spheres=spheres)


def tissue(entropy: int, per_mm3: float = 60.0) -> TiledMedium:
    """Layered tissue: skin, fat, muscle between fascias, fibres and clusters, cysts, a poorly filled depth.

    Fibres mostly run along the sweep and outlast the beam's thickness, by an amount that varies with depth
    as the beam's thickness does: speckle there is partly coherent and decorrelates too slowly.
    """
    rng = np.random.default_rng([entropy, 1])
    fascias = np.array([1.5, 6.5, 7.5, 15.0, 16.5, 23.0, 29.5]) + rng.uniform(-0.5, 0.5, 7)
    bright = (0.5, 0.8, 0.35, 0.9, 0.4, 0.7, 0.6)
    cysts = [
        Sphere(
            (float(rng.uniform(3, 35)), float(rng.uniform(9, 28)), float(rng.uniform(0, 20))),
            float(rng.uniform(1.0, 3.0)),
            0.0,
        )
        for _ in range(5)
    ]
    return TiledMedium(
        entropy,
        per_mm3,
        0.4,
        bands=_tissue_bands(fascias),
        spheres=cysts,
        sheets=[_fascia(rng, d, s) for d, s in zip(fascias, bright, strict=True)],
        clusters=_tissue_clusters(rng),
    )


def _tissue_bands(fascias: FloatArray) -> list[DepthBand]:
    edges = [-3.0, *fascias.tolist(), 50.0]
    strengths = (0.8, 0.35, 0.6, 0.8, 1.0, 0.7, 0.9, 0.25)
    fills = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.3)
    rows = zip(edges[:-1], edges[1:], strengths, fills, strict=True)
    return [DepthBand(*row) for row in rows]


def _fascia(rng: np.random.Generator, depth_mm: float, strength: float) -> Sheet:
    """Undulate by a few tenths of a millimetre over one to a few centimetres."""
    waves = np.stack(
        [
            rng.uniform(0.05, 0.25, 4),
            rng.uniform(-0.5, 0.5, 4),
            rng.uniform(-0.3, 0.3, 4),
            rng.uniform(0, 2 * np.pi, 4),
        ],
        axis=1,
    )
    return Sheet(float(depth_mm), waves, strength)


def _tissue_clusters(rng: np.random.Generator) -> list[Clusters]:
    heading, dip = rng.normal(0.0, 0.1), rng.normal(0.0, 0.03)
    along = (float(np.sin(heading)), float(np.sin(dip)), float(np.cos(heading)))
    return [
        Clusters(0.15, 40, 0.045, length_mm=4.0, spread_mm=0.02, direction=along),
        Clusters(0.05, 40, 0.045, length_mm=3.0, spread_mm=0.02, direction=(1.0, 0.0, 0.0)),
        Clusters(0.3, 12, 0.08, spread_mm=0.12, coherent=False),
    ]


MEDIA: dict[str, Callable[[int], TiledMedium]] = {
    "fully_developed": fully_developed,
    "phantom": phantom,
    "tissue": tissue,
}
"""Media by the name that presets use."""
