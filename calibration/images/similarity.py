"""How alike the images of two sweeps are for a given calibration, each compared with cuts of the other."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform

from calibration.images.stacks import Stack
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.kernels.slicing import PARAMETERS, compare_patches

LEAST_SHARE = 0.5
"""Part of a patch that the other sweep must show."""

FEWEST_PATCHES = 0.1
"""Part of the patches that must have support; fewer say nothing of how well the sweeps fit."""


@dataclass(frozen=True)
class Patches:
    """Squares of grid points on some of a sweep's images.

    Attributes
    ----------
    where : ndarray of int, shape (p, 3)
        Number of the image in its stack, and first pixel.
    sides : tuple of int
        Points along u and v.
    stride : int
        Pixels between them.
    """

    where: IntArray
    sides: tuple[int, int]
    stride: int


@dataclass(frozen=True)
class Likeness:
    """Correlation of patches with the other sweep, both ways, one after the other.

    Attributes
    ----------
    alike : ndarray, shape (p,)
        NaN where a patch has too little support.
    energy : ndarray, shape (p, 2)
        Standard deviation of the patch and of what was cut: grey levels.
    normal, gradient : ndarray, shape (p, 8, 8) and (p, 8)
        By the image's turns (rad) and displacements (mm), and the relative pixel sizes; empty without.
    """

    alike: FloatArray
    energy: FloatArray
    share: FloatArray
    normal: FloatArray
    gradient: FloatArray

    @property
    def valid(self) -> BoolArray:
        """Which patches have enough support."""
        return np.asarray(np.isfinite(self.alike))

    @property
    def mean(self) -> float:
        """Mean correlation of the patches that have support; NaN if none has."""
        return float(self.alike[self.valid].mean()) if self.valid.any() else float("nan")

    @property
    def score(self) -> float:
        """Mean correlation by contrast, times the root of the share of patches that have support.

        For comparing places far apart: chance correlations fall with the root of the number of patches, so
        that a few patches that happen to be alike do not win over many that are.
        """
        valid = self.valid
        if valid.sum() < max(3.0, FEWEST_PATCHES * len(valid)):
            return -1.0
        contrast = np.sqrt(self.energy[valid].prod(axis=1))
        weight = contrast / (contrast + np.median(contrast))
        return float(weight @ self.alike[valid] / weight.sum() * np.sqrt(valid.mean()))


@dataclass(frozen=True)
class Comparison:
    """Two stacks, and patches on each that are looked for in the other.

    `sources` are the stacks that are cut, the other one's patches against each; by default the stacks.
    """

    stacks: tuple[Stack, Stack]
    patches: tuple[Patches, Patches]
    max_gap_mm: float
    sources: tuple[Stack, Stack] | None = None
    least_share: float = LEAST_SHARE

    def at(
        self,
        sensor_from_image: RigidTransform,
        scales: FloatArray | None = None,
        derivatives: bool = False,
        pool: ThreadPoolExecutor | None = None,
    ) -> Likeness:
        """Compare at a calibration; pixel sizes are multiplied by `scales`, shape (2,)."""
        matrix = sensor_from_image.as_matrix()
        factor = np.ones(2) if scales is None else scales
        run = pool.map if pool else map
        parts = list(run(lambda way: self._one_way(way, matrix, factor, derivatives), (0, 1)))
        return Likeness(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    @property
    def images(self) -> IntArray:
        """Which sweep, and which image of its stack, each patch is on, shape (p, 2)."""
        rows = [
            np.column_stack([np.full(len(p.where), n), p.where[:, 0]]) for n, p in enumerate(self.patches)
        ]
        return np.concatenate(rows)

    def places_mm(self, sensor_from_image: RigidTransform) -> FloatArray:
        """Where the patches' centres lie in the world, shape (p, 3)."""
        rows = []
        for stack, patches in zip(self.stacks, self.patches, strict=True):
            half = 0.5 * (np.array(patches.sides) - 1) * patches.stride
            flat = stack.pixels[2:] + (patches.where[:, 1:] + half) * stack.pixels[:2]
            local = np.column_stack([flat, np.zeros(len(flat)), np.ones(len(flat))])
            poses = stack.sensor_matrices[patches.where[:, 0]] @ sensor_from_image.as_matrix()
            rows.append(np.einsum("pij,pj->pi", poses, local)[:, :3])
        return np.concatenate(rows)

    def _one_way(
        self, way: int, matrix: FloatArray, factor: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, ...]:
        sample, patches = self.stacks[way], self.patches[way]
        source = (self.sources or self.stacks)[1 - way]
        count = len(patches.where)
        alike, share, energy = np.empty(count), np.empty(count), np.empty((count, 2))
        size = count if derivatives else 0
        normal, gradient = np.empty((size, PARAMETERS, PARAMETERS)), np.empty((size, PARAMETERS))
        compare_patches(
            sample.images,
            np.ascontiguousarray((sample.sensor_matrices @ matrix)[:, :3]),
            sample.pixels * np.tile(factor, 2),
            source.images,
            _inverted(source.sensor_matrices @ matrix),
            source.pixels * np.tile(factor, 2),
            patches.where,
            patches.sides,
            patches.stride,
            self.max_gap_mm,
            self.least_share,
            alike,
            energy,
            share,
            normal,
            gradient,
        )
        return alike, energy, share, normal, gradient


def spread_patches(
    stack: Stack, images: Sequence[int] | IntArray, side: int, spacing_mm: float, overlap: float = 0.5
) -> Patches:
    """Square patches all over some images, leaving out those that mostly show nothing.

    Parameters
    ----------
    spacing_mm : float
        Distance between a patch's points.
    overlap : float
        Part of its side that a patch shares with its neighbour.
    """
    stride = max(1, round(spacing_mm / float(stack.pixels[:2].mean())))
    size = stack.images.shape[1:]
    side = min(side, (min(size) - 1) // stride + 1)
    reach = (side - 1) * stride
    step = max(1.0, reach * (1.0 - overlap))
    starts = [np.unique(np.linspace(0, n - 1 - reach, int((n - 1 - reach) / step) + 1).round()) for n in size]
    kept = []
    for image in images:
        there = np.isfinite(stack.images[image])
        for a, b in product(starts[0].astype(int), starts[1].astype(int)):
            if there[a : a + reach + 1 : stride, b : b + reach + 1 : stride].mean() > LEAST_SHARE:
                kept.append((image, a, b))
    return Patches(np.array(kept, dtype=np.int64).reshape(-1, 3), (side, side), stride)


def whole_images(stack: Stack, images: IntArray, spacing_mm: float) -> Patches:
    """One patch over each of some images, its points about `spacing_mm` apart."""
    stride = max(1, round(spacing_mm / float(stack.pixels[:2].mean())))
    u, v = ((n - 1) // stride + 1 for n in stack.images.shape[1:])
    where = np.column_stack([images, np.zeros((len(images), 2), np.int64)]).astype(np.int64)
    return Patches(where, (u, v), stride)


def _inverted(matrices: FloatArray) -> FloatArray:
    """Inverse of rigid matrices, shape (n, 4, 4) to (n, 3, 4)."""
    out = np.empty((len(matrices), 3, 4))
    out[:, :, :3] = np.swapaxes(matrices[:, :3, :3], 1, 2)
    out[:, :, 3] = -np.einsum("nij,nj->ni", out[:, :, :3], matrices[:, :3, 3])
    return out
