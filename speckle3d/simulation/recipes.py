"""Media by name: a uniform phantom, a phantom with inclusions, tissue."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from speckle3d.simulation.medium import Clusters, Layer, Sphere, TiledMedium, Waves


def fully_developed(entropy: int, length_mm: float, per_mm3: float = 100.0) -> TiledMedium:
    """Make a uniform speckle phantom."""
    return TiledMedium(entropy, per_mm3, 0.3)


def phantom(entropy: int, length_mm: float, per_mm3: float = 100.0) -> TiledMedium:
    """Make a speckle phantom with spherical inclusions, brighter and darker by 6 to 12 dB."""
    rng = np.random.default_rng([entropy, 1])
    factors = (2.0, 0.5, 0.25, 3.0, 0.5)
    return TiledMedium(
        entropy, per_mm3, 0.3, spheres=[_sphere(rng, length_mm, (1.5, 4.0), f) for f in factors]
    )


def tissue(entropy: int, length_mm: float, per_mm3: float = 100.0) -> TiledMedium:
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
    return TiledMedium(
        entropy, per_mm3, 0.4, layers, texture, _tissue_clusters(rng, tops.tolist()), spheres=cysts
    )


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


MEDIA: dict[str, Callable[[int, float], TiledMedium]] = {
    "fully_developed": fully_developed,
    "phantom": phantom,
    "tissue": tissue,
}
"""Media by the name that presets use; each takes a seed and the length of the sweep."""
