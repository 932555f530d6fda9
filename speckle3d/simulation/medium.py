"""Media of point scatterers, in a frame whose axes are lateral, depth and along the sweep.

Media are made tile by tile as the beam reaches them, each tile from its own seed, so that a sweep of any
length needs the memory of its neighbourhood only and the same seed always gives the same scatterers. The
media that presets name are at the end: a uniform phantom, a phantom with inclusions, tissue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.random import Generator, default_rng
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray

Scatterers = tuple[FloatArray, Float32Array]
"""Positions, shape (n, 3), mm, and strengths, shape (n,): unit strength at 1 per mm^3 is the reference."""

_KEPT_TILES = 200
"""A frame of 127 vectors sees about 40 tiles; the rest serve neighbouring frames and turned ones."""

TILE_MM = 4.0
"""Side of the square columns that media are made in; no cluster reaches further than this from its parent."""

_PER_MM3 = 100.0
"""Density of the diffuse background of the media that presets name."""

_DEPTH_BIN_MM = 0.25
"""Tiles are sorted by depth in such steps, half of the beam table's."""

_FASCIA_PER_MM2 = 60.0
"""Density of scatterers on a reflecting sheet."""

_CELL_MM = 0.5
"""Lateral and elevational side of cells with one background scatterer each: the focused beam's width."""


Box = tuple[FloatArray, FloatArray]
"""Opposite corners of a box of the image, the lower first, mm."""


Tile = tuple[int, int]
"""Number of a tile along x and along z."""


def tiles_near(medium_from_image: RigidTransform, box: Box) -> list[Tile]:
    """Tiles of a medium that together hold a box of the image."""
    corners = np.stack(np.meshgrid(*np.transpose(box)), axis=-1).reshape(-1, 3)
    extent = np.floor(medium_from_image.apply(corners)[:, [0, 2]] / TILE_MM).astype(int)
    (i, j), (last_i, last_j) = extent.min(axis=0).tolist(), extent.max(axis=0).tolist()
    return list(product(range(i, last_i + 1), range(j, last_j + 1)))


def tile_rng(tile: Tile, *seed: int) -> Generator:
    """Random numbers of a part of a tile."""
    # Seeds are not negative: remainders are distinct on either side of the origin.
    return default_rng([*seed, *(number % 2**32 for number in tile)])


def tile_corner(tile: Tile, depth_mm: float = 0.0) -> FloatArray:
    """First corner of a tile, at a depth."""
    return np.array([tile[0] * TILE_MM, depth_mm, tile[1] * TILE_MM])


def wave_sum(waves: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Sum of plane sinusoids at positions, shape (n, 3).

    ``waves`` holds one in a row: amplitude, wave number along x, y and z (rad/mm), phase (rad).
    """
    return np.sin(position_mm @ waves[:, 1:4].T + waves[:, 4]) @ waves[:, 0]


def random_waves(rng: Generator, rms: float, waves_rad_mm: Sequence[float], count: int = 6) -> FloatArray:
    """Draw `count` waves of given largest wave numbers, together of `rms`."""
    amplitude = np.full(count, rms * np.sqrt(2.0 / count))
    numbers = rng.uniform(-1.0, 1.0, (count, 3)) * waves_rad_mm
    return np.column_stack([amplitude, numbers, rng.uniform(0.0, 2.0 * np.pi, count)])


class Layer(NamedTuple):
    """Tissue from an undulating boundary down to that of the next layer.

    Attributes
    ----------
    top_mm, undulation : float, ndarray
        Mean depth of the boundary and its shape; the waves' amplitudes are in mm.
    strength, fill : float
        Of the diffuse background: relative echo strength, and the part of its scatterers that are there.
    fascia : float
        Strength per mm^2 of a thin reflecting sheet on the boundary; its scatterers share one sign.
    """

    top_mm: float
    undulation: FloatArray
    strength: float
    fascia: float = 0.0
    fill: float = 1.0

    def covers(self, position_mm: FloatArray) -> BoolArray:
        """Whether positions, shape (n, 3), lie below the boundary."""
        below = position_mm[:, 1] - self.top_mm
        # Waves are slow to evaluate, so only near the boundary, where they can change the answer.
        near = np.flatnonzero(np.abs(below) <= np.abs(self.undulation[:, 0]).sum())
        below[near] -= wave_sum(self.undulation, position_mm[near] * [1.0, 0.0, 1.0])
        return below >= 0.0


class Clusters(NamedTuple):
    """Neyman-Scott clusters, round or drawn out into fibres: parents at random, children about them.

    Attributes
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


@dataclass(frozen=True, eq=False)
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
    texture : ndarray, optional
        Slow variation of the background's echo strength, in nepers.
    clusters : sequence of Clusters
    spheres : sequence of tuple
        Centre and radius of balls, mm, and what they multiply echo strengths by (0: an anechoic cyst).
    objects : sequence of Scatterers
        In every box, wherever they lie.
    depth_mm : tuple of float
        The slab, from a little above the skin so that a probe may move up.
    """

    entropy: int
    per_mm3: float
    attenuation_db_cm_mhz: float
    layers: Sequence[Layer] = ()
    texture: FloatArray | None = None
    clusters: Sequence[Clusters] = ()
    spheres: Sequence[tuple[FloatArray, float, float]] = ()
    depth_mm: tuple[float, float] = (-3.0, 50.0)
    objects: Sequence[Scatterers] = ()

    def scatterers(self, medium_from_image: RigidTransform, box: Box) -> list[Scatterers]:
        """Blocks of scatterers, in the medium, that include all those in a box of the image."""
        return [*(_scatterers(self, tile) for tile in tiles_near(medium_from_image, box)), *self.objects]

    def _background(self, tile: Tile) -> Scatterers:
        """Half of the scatterers Poisson distributed, half of them one anywhere in each of equal cells.

        Few scatterers per resolution cell make intensity vary more than fully developed speckle's if they
        are Poisson distributed, and less by as much if their number does not vary. Half and half, the
        moments up to the fourth, and so the correlation of intensity, are those of a dense medium.
        """
        rng, (top, bottom) = tile_rng(tile, self.entropy, 0), self.depth_mm
        height, per_mm3 = bottom - top, self.per_mm3 / 2.0
        loose = rng.random((rng.poisson(per_mm3 * height * TILE_MM**2), 3)) * [TILE_MM, height, TILE_MM]
        across, down = round(TILE_MM / _CELL_MM), round(height * per_mm3 * _CELL_MM**2)
        cell = np.indices((across, down, across)).reshape(3, -1).T
        spread = (cell + rng.random(cell.shape)) * [_CELL_MM, height / down, _CELL_MM]
        position = np.concatenate([loose, spread]) + tile_corner(tile, top)
        n = len(position)
        strength, fill = np.ones((2, n))
        for layer in self.layers:
            below = layer.covers(position)
            strength[below], fill[below] = layer.strength, layer.fill
        if self.texture is not None:
            strength *= np.exp(wave_sum(self.texture, position))
        # Equal strengths of random sign give fully developed speckle with the fewest scatterers.
        strength *= rng.choice([-1.0, 1.0], n) / np.sqrt(self.per_mm3)
        present = rng.random(n) < fill
        return position[present], strength[present].astype(np.float32)

    def _fascia(self, tile: Tile, layer: Layer, number: int) -> Scatterers:
        rng = tile_rng(tile, self.entropy, 1 + number)
        n = rng.poisson(_FASCIA_PER_MM2 * TILE_MM**2)
        position = tile_corner(tile) + rng.random((n, 3)) * [TILE_MM, 0.0, TILE_MM]
        position[:, 1] = layer.top_mm + wave_sum(layer.undulation, position) + rng.normal(0.0, 0.015, n)
        return position, np.full(n, layer.fascia / _FASCIA_PER_MM2, np.float32)


@lru_cache(_KEPT_TILES)
def _scatterers(medium: TiledMedium, tile: Tile) -> Scatterers:
    """All scatterers of one tile."""
    parts = [medium._background(tile)]
    parts += [medium._fascia(tile, layer, n) for n, layer in enumerate(medium.layers) if layer.fascia]
    # Children of a neighbouring tile's parents may lie in this tile.
    i, j = tile
    for near in product(range(i - 1, i + 2), range(j - 1, j + 2)):
        for number, clusters in enumerate(medium.clusters, 1000):
            position, strength = _children(clusters, near, medium.entropy, number)
            inside = (np.floor(position[:, [0, 2]] / TILE_MM) == tile).all(axis=1)
            parts.append((position[inside], strength[inside]))
    position, strength = map(np.concatenate, zip(*parts, strict=True))
    for centre_mm, radius_mm, factor in medium.spheres:
        inside = ((position - centre_mm) ** 2).sum(axis=1) < radius_mm**2
        strength[inside] *= factor
    present = np.flatnonzero(strength)
    # By depth, so that neighbours meet the same part of the beam's table.
    depth = (position[present, 1] - medium.depth_mm[0]) / _DEPTH_BIN_MM
    present = present[np.argsort(depth.astype(np.int16), kind="stable")]
    return position[present], strength[present]


@lru_cache(5 * _KEPT_TILES)
def _children(clusters: Clusters, tile: Tile, *seed: int) -> Scatterers:
    """Children of the parents in one tile; some lie outside it."""
    rng, (top, bottom) = tile_rng(tile, *seed), clusters.depth_mm
    n, children = rng.poisson(clusters.per_mm3 * (bottom - top) * TILE_MM**2), clusters.children
    parent = tile_corner(tile, top) + rng.random((n, 3)) * [TILE_MM, bottom - top, TILE_MM]
    axis = clusters.direction + clusters.wander_rad * rng.standard_normal((n, 3))
    axis *= (clusters.length_mm * rng.uniform(0.25, 1.0, n) / np.linalg.norm(axis, axis=1))[:, None]
    along = rng.random((n, children, 1)) - 0.5
    across = clusters.spread_mm * np.clip(rng.standard_normal((n, children, 3)), -3.0, 3.0)
    position = parent[:, None] + along * axis[:, None] + across
    signs = rng.choice([-1.0, 1.0], (n, 1 if clusters.coherent else children))
    strength = np.broadcast_to(clusters.strength * signs, (n, children))
    return position.reshape(-1, 3), strength.ravel().astype(np.float32)


def fully_developed(entropy: int) -> TiledMedium:
    """Make a uniform speckle phantom."""
    return TiledMedium(entropy, _PER_MM3, 0.3)


def phantom(entropy: int, length_mm: float) -> TiledMedium:
    """Make a speckle phantom with spherical inclusions, brighter and darker by 6 to 12 dB."""
    rng = default_rng([entropy, 1])
    spheres = [_sphere(rng, length_mm, (1.5, 4.0), factor) for factor in (2.0, 0.5, 0.25, 3.0, 0.5)]
    return TiledMedium(entropy, _PER_MM3, 0.3, spheres=spheres)


def tissue(entropy: int, length_mm: float) -> TiledMedium:
    """Make layered tissue: skin, fat, muscles between fascias, cysts, and a poorly filled depth.

    Fibres run mostly along the sweep and are longer than the beam is thick, more of them in some muscles
    than in others: there speckle is partly coherent and decorrelates too slowly.
    """
    rng = default_rng([entropy, 1])
    tops = np.array([-3.0, 1.5, 6.5, 7.5, 15.0, 16.2, 23.0, 30.0])
    tops[2:] += rng.uniform(-0.5, 0.5)
    strengths = (0.9, 0.35, 0.7, 0.55, 0.9, 0.7, 0.45, 0.2)
    fascias = (0.0, 1.0, 1.6, 0.8, 2.0, 1.0, 1.6, 1.2)
    layers = [
        Layer(top, random_waves(rng, 0.25, (0.25, 0.0, 0.2)), *properties)
        for top, *properties in zip(tops, strengths, fascias, strict=True)
    ]
    layers[-1] = layers[-1]._replace(fill=0.2)
    texture = random_waves(rng, 0.25, (2.0, 2.0, 2.0), 12)
    cysts = [_sphere(rng, length_mm, (1.0, 2.5), 0.0) for _ in range(6)]
    heading, dip = rng.normal(0.0, 0.1), rng.normal(0.0, 0.02)
    along = (np.sin(heading), np.sin(dip), np.cos(heading))
    _, skin, _, first, second, third, fourth, deep = tops.tolist()
    # Fibres in three muscles, in ever larger numbers with depth, crossing septa, and round clusters.
    clusters = [
        Clusters(0.5, 24, 0.05, (first, second), 6.0, 0.02, along),
        Clusters(0.9, 24, 0.05, (third, fourth), 6.0, 0.02, along),
        Clusters(1.3, 24, 0.05, (fourth, deep), 6.0, 0.02, along),
        Clusters(0.12, 24, 0.06, (skin, deep), 5.0, 0.02, (1.0, 0.05, 0.1), 0.1),
        Clusters(0.25, 12, 0.09, (skin, 42.0), spread_mm=0.12, coherent=False),
    ]
    return TiledMedium(entropy, _PER_MM3, 0.4, layers, texture, clusters, cysts)


def _sphere(
    rng: Generator, length_mm: float, radius_mm: tuple[float, float], factor: float
) -> tuple[FloatArray, float, float]:
    centre = rng.uniform([3.0, 8.0, 0.0], [35.0, 34.0, length_mm])
    return centre, rng.uniform(*radius_mm), factor
