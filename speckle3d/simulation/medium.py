"""Media of point scatterers, in a frame whose axes are lateral, depth and along the sweep.

Media are made tile by tile as the beam reaches them, each tile from its own seed, so that a sweep of any
length needs the memory of its neighbourhood only and the same seed always gives the same scatterers. The
media that presets name are at the end: a uniform phantom, a phantom with inclusions, tissue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray
from speckle3d.simulation.tiles import Tiles, tile_seed

Scatterers = tuple[FloatArray, Float32Array]
"""Positions, shape (n, 3), mm, and strengths, shape (n,): unit strength at 1 per mm^3 is the reference."""

_KEPT_TILES = 160
"""A frame of 127 vectors sees about 40 tiles; the rest serve neighbouring frames and turned ones."""


_PER_MM3 = 100.0
"""Density of the diffuse background of the media that presets name."""

_DEPTH_BIN_MM = 0.25
"""Tiles are sorted by depth in such steps, half of the beam table's."""

_CELL_MM = 0.5
"""Lateral and elevational side of cells with one background scatterer each: the focused beam's width."""


class Medium(Protocol):
    """Anything that can list its scatterers in a box."""

    @property
    def attenuation_db_cm_mhz(self) -> float:
        """One-way attenuation, proportional to frequency."""

    def seen(
        self, medium_from_image: RigidTransform, low_mm: FloatArray, high_mm: FloatArray
    ) -> list[Scatterers]:
        """Blocks of scatterers, in the medium, that include all those in a box of the image."""


def bounds_in_medium(
    medium_from_image: RigidTransform, low_mm: FloatArray, high_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Opposite corners, in the medium, of the upright box about a box of the image."""
    x, y, z = np.stack([low_mm, high_mm], axis=-1)
    corners = np.stack(np.meshgrid(x, y, z), axis=-1)
    seen = medium_from_image.apply(corners.reshape(-1, 3))
    return seen.min(axis=0), seen.max(axis=0)


@dataclass(frozen=True)
class Waves:
    """A smooth function of position: a sum of plane sinusoids.

    ``rows`` holds one sinusoid each: amplitude, wave number along x, y and z (rad/mm), phase (rad).
    """

    rows: FloatArray

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Value at positions, shape (n, 3)."""
        return np.asarray(np.sin(position_mm @ self.rows[:, 1:4].T + self.rows[:, 4]) @ self.rows[:, 0])

    @property
    def largest(self) -> float:
        """Bound on the absolute value."""
        return float(np.abs(self.rows[:, 0]).sum())

    @staticmethod
    def random(rng: np.random.Generator, rms: float, waves_rad_mm: Sequence[float], count: int = 6) -> Waves:
        """Draw `count` waves of given largest wave numbers, together of `rms`."""
        rows = np.empty((count, 5))
        rows[:, 0] = rms * np.sqrt(2.0 / count)
        rows[:, 1:4] = rng.uniform(-1.0, 1.0, (count, 3)) * waves_rad_mm
        rows[:, 4] = rng.uniform(0.0, 2.0 * np.pi, count)
        return Waves(rows)


@dataclass(frozen=True)
class Sphere:
    """A ball in which echo strengths are multiplied by `factor` (0: an anechoic cyst)."""

    centre_mm: tuple[float, float, float]
    radius_mm: float
    factor: float


@dataclass(frozen=True)
class Layer:
    """What lies below an undulating boundary, down to the next layer's.

    Parameters
    ----------
    top_mm, undulation : float, Waves
        Mean depth of the boundary and its shape; the waves' amplitudes are in mm.
    strength, fill : float
        Of the diffuse background: relative echo strength, and the part of its scatterers that are there.
    fascia : float
        Strength per mm^2 of a thin reflecting sheet on the boundary; its scatterers share one sign.
    """

    top_mm: float
    undulation: Waves
    strength: float
    fill: float = 1.0
    fascia: float = 0.0

    def top_at(self, position_mm: FloatArray) -> FloatArray:
        """Depth of the boundary above or below positions, shape (n, 3)."""
        return np.asarray(self.top_mm + self.undulation.at(position_mm * [1.0, 0.0, 1.0]))

    def covers(self, position_mm: FloatArray) -> BoolArray:
        """Whether positions, shape (n, 3), lie below the boundary."""
        below = position_mm[:, 1] - self.top_mm
        # Waves are slow to evaluate, so only near the boundary, where they can change the answer.
        near = np.flatnonzero(np.abs(below) <= self.undulation.largest)
        below[near] -= self.undulation.at(position_mm[near] * [1.0, 0.0, 1.0])
        return np.asarray(below >= 0.0)


@dataclass(frozen=True)
class Clusters:
    """Neyman-Scott clusters, round or drawn out into fibres: parents at random, children about them.

    Parameters
    ----------
    per_mm3, children, strength : float
        Density of parents, children of each, and a child's strength.
    depth_mm : tuple of float
        Where parents are.
    length_mm : float
        Longest fibre; lengths are uniform from a quarter of it. Zero for round clusters.
    spread_mm : float
        Standard deviation of children across the fibre, or in all directions.
    direction, wander_rad : tuple of float, float
        Fibres' mean direction in the medium, and their scatter about it.
    coherent : bool
        Whether the children of one parent share one sign.
    """

    per_mm3: float
    children: int
    strength: float
    depth_mm: tuple[float, float]
    length_mm: float = 0.0
    spread_mm: float = 0.1
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    wander_rad: float = 0.05
    coherent: bool = True

    def draw(self, rng: np.random.Generator, corner_mm: FloatArray, side_mm: float) -> Scatterers:
        """Children of the parents in one square column; some lie outside it."""
        size = np.array([side_mm, self.depth_mm[1] - self.depth_mm[0], side_mm])
        n = rng.poisson(self.per_mm3 * size.prod())
        parent = np.array([corner_mm[0], self.depth_mm[0], corner_mm[1]]) + rng.random((n, 3)) * size
        axis = np.asarray(self.direction) + self.wander_rad * rng.standard_normal((n, 3))
        axis *= (self.length_mm * rng.uniform(0.25, 1.0, n) / np.linalg.norm(axis, axis=1))[:, None]
        along = rng.random((n, self.children, 1)) - 0.5
        across = self.spread_mm * np.clip(rng.standard_normal((n, self.children, 3)), -3.0, 3.0)
        position = parent[:, None] + along * axis[:, None] + across
        signs = rng.choice([-1.0, 1.0], (n, 1 if self.coherent else self.children))
        strength = np.broadcast_to(self.strength * signs, (n, self.children))
        return position.reshape(-1, 3), strength.ravel().astype(np.float32)


@dataclass(frozen=True)
class TiledMedium:
    """A slab without sides, made on demand in square columns.

    Parameters
    ----------
    entropy : int
        Seed; with a tile's indices it determines the tile.
    per_mm3 : float
        Density of the diffuse background.
    layers : sequence of Layer
        From the skin down.
    texture : Waves, optional
        Slow variation of the background's echo strength, in nepers.
    clusters, spheres
        Spheres multiply whatever lies in them.
    depth_mm : tuple of float
        The slab, from a little above the skin so that a probe may move up.
    tile_mm : float
        Side of the columns; no cluster may reach further than this from its parent.
    """

    entropy: int
    per_mm3: float
    attenuation_db_cm_mhz: float
    layers: Sequence[Layer] = ()
    texture: Waves | None = None
    clusters: Sequence[Clusters] = ()
    spheres: Sequence[Sphere] = ()
    depth_mm: tuple[float, float] = (-3.0, 50.0)
    tile_mm: float = 4.0
    fascia_per_mm2: float = 60.0

    def seen(
        self, medium_from_image: RigidTransform, low_mm: FloatArray, high_mm: FloatArray
    ) -> list[Scatterers]:
        """Tiles that together hold all scatterers in a box of the image."""
        return self.within(*bounds_in_medium(medium_from_image, low_mm, high_mm))

    def within(self, low_mm: FloatArray, high_mm: FloatArray) -> list[Scatterers]:
        """Tiles that together hold all scatterers between the corners."""
        first = np.floor(low_mm[[0, 2]] / self.tile_mm).astype(int)
        last = np.floor(high_mm[[0, 2]] / self.tile_mm).astype(int)
        columns = range(first[0], last[0] + 1), range(first[1], last[1] + 1)
        return self._tiles((i, j) for i in columns[0] for j in columns[1])

    @cached_property
    def _tiles(self) -> Tiles[Scatterers]:
        return Tiles(self._make, _KEPT_TILES)

    @cached_property
    def _families(self) -> Tiles[Scatterers]:
        return Tiles(self._draw, _KEPT_TILES)

    def _make(self, i: int, j: int) -> Scatterers:
        parts = [self._background(i, j)]
        parts += [self._fascia(layer, n, i, j) for n, layer in enumerate(self.layers) if layer.fascia]
        # Children of a neighbouring tile's parents may lie in this tile.
        around = [(i + di, j + dj) for di in (-1, 0, 1) for dj in (-1, 0, 1)] if self.clusters else []
        parts += [_within(i, j, self.tile_mm, family) for family in self._families(around)]
        position = np.concatenate([p for p, _ in parts])
        strength = np.concatenate([s for _, s in parts])
        for sphere in self.spheres:
            inside = ((position - sphere.centre_mm) ** 2).sum(axis=1) < sphere.radius_mm**2
            strength[inside] *= sphere.factor
        kept = np.flatnonzero(strength)
        # By depth, so that neighbours meet the same part of the beam's table.
        depth = (position[kept, 1] - self.depth_mm[0]) / _DEPTH_BIN_MM
        kept = kept[np.argsort(depth.astype(np.int16), kind="stable")]
        return position[kept], strength[kept]

    def _rng(self, part: int, i: int, j: int) -> np.random.Generator:
        return np.random.default_rng([self.entropy, part, *tile_seed(i, j)])

    def _background(self, i: int, j: int) -> Scatterers:
        rng = self._rng(0, i, j)
        position = np.concatenate([self._at_random(rng), self._one_per_cell(rng)])
        position += [i * self.tile_mm, self.depth_mm[0], j * self.tile_mm]
        n = len(position)
        strength, fill = np.ones(n), np.ones(n)
        for layer in self.layers:
            below = layer.covers(position)
            strength[below], fill[below] = layer.strength, layer.fill
        if self.texture is not None:
            strength *= np.exp(self.texture.at(position))
        # Equal strengths of random sign give fully developed speckle with the fewest scatterers.
        strength *= rng.choice([-1.0, 1.0], n) / np.sqrt(self.per_mm3)
        kept = rng.random(n) < fill
        return position[kept], strength[kept].astype(np.float32)

    def _at_random(self, rng: np.random.Generator) -> FloatArray:
        """Half of the background, Poisson distributed over a tile at the origin."""
        size = np.array([self.tile_mm, self.depth_mm[1] - self.depth_mm[0], self.tile_mm])
        return np.asarray(rng.random((rng.poisson(self.per_mm3 / 2.0 * size.prod()), 3)) * size)

    def _one_per_cell(self, rng: np.random.Generator) -> FloatArray:
        """Return the other half of the background: one scatterer anywhere in each of equal cells.

        Few scatterers per resolution cell make intensity vary more than fully developed speckle's if they
        are Poisson distributed, and less by as much if their number does not vary. Half and half, the
        moments up to the fourth, and so the correlation of intensity, are those of a dense medium.
        """
        across = round(self.tile_mm / _CELL_MM)
        side = self.tile_mm / across
        height = self.depth_mm[1] - self.depth_mm[0]
        down = round(height * self.per_mm3 / 2.0 * side**2)
        cell = np.indices((across, down, across)).reshape(3, -1).T
        return np.asarray((cell + rng.random(cell.shape)) * [side, height / down, side])

    def _fascia(self, layer: Layer, number: int, i: int, j: int) -> Scatterers:
        rng = self._rng(1 + number, i, j)
        n = rng.poisson(self.fascia_per_mm2 * self.tile_mm**2)
        position = [i * self.tile_mm, 0.0, j * self.tile_mm] + rng.random((n, 3)) * [
            self.tile_mm,
            0.0,
            self.tile_mm,
        ]
        position[:, 1] = layer.top_at(position) + rng.normal(0.0, 0.015, n)
        return position, np.full(n, layer.fascia / self.fascia_per_mm2, np.float32)

    def _draw(self, i: int, j: int) -> Scatterers:
        """Children of all parents in a tile; some lie outside it."""
        corner = np.array([i, j]) * self.tile_mm
        drawn = [
            kind.draw(self._rng(1000 + number, i, j), corner, self.tile_mm)
            for number, kind in enumerate(self.clusters)
        ]
        return np.concatenate([p for p, _ in drawn]), np.concatenate([s for _, s in drawn])


def _within(i: int, j: int, tile_mm: float, scatterers: Scatterers) -> Scatterers:
    position, strength = scatterers
    mine = (np.floor(position[:, [0, 2]] / tile_mm) == [i, j]).all(axis=1)
    return position[mine], strength[mine]


def fully_developed(entropy: int, length_mm: float) -> TiledMedium:
    """Make a uniform speckle phantom."""
    return TiledMedium(entropy, _PER_MM3, 0.3)


def phantom(entropy: int, length_mm: float) -> TiledMedium:
    """Make a speckle phantom with spherical inclusions, brighter and darker by 6 to 12 dB."""
    rng = np.random.default_rng([entropy, 1])
    factors = (2.0, 0.5, 0.25, 3.0, 0.5)
    spheres = [_sphere(rng, length_mm, (1.5, 4.0), factor) for factor in factors]
    return TiledMedium(entropy, _PER_MM3, 0.3, spheres=spheres)


def tissue(entropy: int, length_mm: float) -> TiledMedium:
    """Make layered tissue: skin, fat, muscles between fascias, cysts, and a poorly filled depth.

    Fibres run mostly along the sweep and are longer than the beam is thick, more of them in some muscles
    than in others: there speckle is partly coherent and decorrelates too slowly.
    """
    rng = np.random.default_rng([entropy, 1])
    tops = np.array([-3.0, 1.5, 6.5, 7.5, 15.0, 16.2, 23.0, 30.0])
    tops[2:] += rng.uniform(-0.5, 0.5)
    strengths = (0.9, 0.35, 0.7, 0.55, 0.9, 0.7, 0.45, 0.2)
    fills = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.2)
    fascias = (0.0, 1.0, 1.6, 0.8, 2.0, 1.0, 1.6, 1.2)
    layers = [
        Layer(float(top), Waves.random(rng, 0.25, (0.25, 0.0, 0.2)), *rest)
        for top, *rest in zip(tops, strengths, fills, fascias, strict=True)
    ]
    texture = Waves.random(rng, 0.25, (2.0, 2.0, 2.0), 12)
    cysts = [_sphere(rng, length_mm, (1.0, 2.5), 0.0) for _ in range(6)]
    clusters = _tissue_clusters(rng, tops.tolist())
    return TiledMedium(entropy, _PER_MM3, 0.4, layers, texture, clusters, cysts)


def _sphere(
    rng: np.random.Generator, length_mm: float, radius_mm: tuple[float, float], factor: float
) -> Sphere:
    centre = rng.uniform([3.0, 8.0, 0.0], [35.0, 34.0, length_mm])
    x, y, z = (float(c) for c in centre)
    return Sphere((x, y, z), float(rng.uniform(*radius_mm)), factor)


def _tissue_clusters(rng: np.random.Generator, tops: Sequence[float]) -> list[Clusters]:
    """Fibres in three muscles, in ever larger numbers with depth, crossing septa, and round clusters."""
    heading, dip = rng.normal(0.0, 0.1), rng.normal(0.0, 0.02)
    along = (float(np.sin(heading)), float(np.sin(dip)), float(np.cos(heading)))
    muscles = [(tops[3], tops[4]), (tops[5], tops[6]), (tops[6], tops[7])]
    fibres = [
        Clusters(density, 24, 0.05, depth, length_mm=6.0, spread_mm=0.02, direction=along)
        for density, depth in zip((0.5, 0.9, 1.3), muscles, strict=True)
    ]
    septa = Clusters(0.12, 24, 0.06, (tops[1], tops[7]), 5.0, 0.02, (1.0, 0.05, 0.1), 0.1)
    round_ones = Clusters(0.25, 12, 0.09, (tops[1], 42.0), spread_mm=0.12, coherent=False)
    return [*fibres, septa, round_ones]
