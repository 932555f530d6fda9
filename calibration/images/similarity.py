"""Similarity of two crossing sweeps for a given calibration: patches of one compared with cuts of the other.

`prepare` reads the sweeps once; `CrossingSweeps` then makes a `Comparison` at any resolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from calibration.images.stacks import BASE_PIXEL_MM, WHOLE, Stack, read_stack
from calibration.points import Recording
from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.errors import MismatchError
from speckle3d.core.geometry import skew
from speckle3d.core.progress import Progress
from speckle3d.core.threads import ahead
from speckle3d.kernels.slicing import PARAMETERS, ImagePatches, PatchScores, PlacedImages, compare_patches

USUAL_EXTENT_MM = 40.0
"""Geometric mean of width and depth of images whose `CrossingSweeps.unit` is one."""

LEAST_OVERLAP = 0.3
"""Part of an image that the other sweep must show for the image to count (Wein and Khamene 2008)."""

LEAST_SHARE = 0.5
"""Part of a patch that the other sweep must show."""

FEWEST_PATCHES = 0.1
"""Part of the patches that must have support for the score to mean anything."""


def step_pose(sensor_from_image: RigidTransform, step: FloatArray, pivot_mm: FloatArray) -> RigidTransform:
    """Turn about a point of the image and displace it, in the image's own frame."""
    # As one product of matrices: transforms check themselves, which takes as long as a small comparison.
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    matrix[:3, 3] = pivot_mm + step[3:] - matrix[:3, :3] @ pivot_mm
    return RigidTransform.from_matrix(sensor_from_image.as_matrix() @ matrix)


def about_pivot(pivot_mm: FloatArray) -> FloatArray:
    """Derivative of the parameters at the image's origin with respect to those at a pivot, shape (6, 6)."""
    base = np.eye(6)
    base[3:, :3] = skew(pivot_mm)
    return base


class Similarity(PatchScores):
    """Correlations of the first sweep's patches with the second sweep, then of the second's with the first.

    `energy` is in grey levels; `normal` and `gradient` are by the image's turns (rad) about the pivot and
    displacements (mm); they are empty if they were not asked for.
    """

    @property
    def valid(self) -> BoolArray:
        """Mask of patches with enough support."""
        return np.isfinite(self.alike)

    @property
    def mean(self) -> float:
        """Mean correlation of the patches that have support; NaN if none has."""
        return float(self.alike[self.valid].mean()) if self.valid.any() else float("nan")

    @property
    def score(self) -> float:
        """Mean correlation weighted by contrast, times the root of the share of patches that have support.

        Made for comparing places far apart. Chance correlations fall with the root of the number of patches,
        so the factor keeps a few patches that correlate by chance from winning over many that do rightly.
        """
        valid = self.valid
        if valid.sum() < max(3.0, FEWEST_PATCHES * len(valid)):
            return -1.0
        contrast = np.sqrt(self.energy[valid].prod(axis=1))
        weight = contrast / (contrast + np.median(contrast))
        return float(weight @ self.alike[valid] / weight.sum() * np.sqrt(valid.mean()))


@dataclass(frozen=True)
class Comparison:
    """Two stacks, with patches on each that are compared with the other."""

    stacks: tuple[Stack, Stack]
    patches: tuple[ImagePatches, ImagePatches]
    max_gap_mm: float
    least_share: float = LEAST_SHARE

    def at(self, sensor_from_image: RigidTransform, derivatives: bool = False) -> Similarity:
        """Compare at a calibration."""
        matrix, size = sensor_from_image.as_matrix(), int(derivatives)

        def one_way(way: int) -> PatchScores:
            sample, patches, source = self.stacks[way], self.patches[way], self.stacks[1 - way]
            count = len(patches.where)
            scores = PatchScores(
                np.empty(count),
                np.empty((count, 2)),
                np.empty(count),
                np.empty((size * count, PARAMETERS, PARAMETERS)),
                np.empty((size * count, PARAMETERS)),
            )
            world_from_sample = np.ascontiguousarray((sample.sensor_matrices @ matrix)[:, :3])
            source_from_world = np.ascontiguousarray(np.linalg.inv(source.sensor_matrices @ matrix)[:, :3])
            compare_patches(
                PlacedImages(sample.images, world_from_sample, sample.pixels),
                PlacedImages(source.images, source_from_world, source.pixels),
                patches,
                self.max_gap_mm,
                self.least_share,
                scores,
            )
            return scores

        parts = list(ahead(one_way, (0, 1)))
        similarity = Similarity(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
        base = about_pivot(self.pivot_mm)
        normal, gradient = base.T @ similarity.normal @ base, similarity.gradient @ base
        return similarity._replace(normal=normal, gradient=gradient)

    @property
    def pivot_mm(self) -> FloatArray:
        """Centre of the first stack's images, which turns leave in place, shape (3,)."""
        return self.stacks[0].centre_mm

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


def spread_patches(
    stack: Stack,
    images: Sequence[int] | IntArray,
    spacing_mm: float,
    side: int | None = None,
    overlap: float = 0.5,
) -> ImagePatches:
    """Patches all over some images, without those that are mostly empty.

    Parameters
    ----------
    spacing_mm : float
        Distance between a patch's points.
    side : int, optional
        Points along each side; by default a patch is the whole image.
    overlap : float
        Part of its side that a patch shares with its neighbour.
    """
    stride = max(1, round(spacing_mm / float(stack.pixels[:2].mean())))
    sides, starts, within = [], [], []
    for size in stack.images.shape[1:]:
        sides.append(min(side or size, (size - 1) // stride + 1))
        last = size - 1 - (sides[-1] - 1) * stride
        count = int(last / max(1.0, (sides[-1] - 1) * stride * (1.0 - overlap))) + 1
        starts.append(np.unique(np.linspace(0, last, count).round()).astype(np.int64))
        within.append(starts[-1][:, None] + stride * np.arange(sides[-1]))
    across, down = within
    corners = []
    for image in images:
        valid = np.isfinite(stack.images[image])
        share = valid[across[:, :, None, None], down[None, None]].mean(axis=(1, 3))
        a, b = np.nonzero(share > LEAST_SHARE)
        corners.append(np.column_stack([np.full(len(a), image), starts[0][a], starts[1][b]]))
    return ImagePatches(np.concatenate(corners).astype(np.int64).reshape(-1, 3), (sides[0], sides[1]), stride)


@dataclass(frozen=True)
class Level:
    """One resolution of comparison, in units of `CrossingSweeps.unit`.

    Attributes
    ----------
    sigma_mm : float
        Standard deviation of the blur.
    images : int
        How many of each sweep are compared.
    side : int
        Points along a patch's side, `sigma_mm` apart.
    overlap : float
        Of neighbouring patches.
    least_weight : float
        Share of the blur that must lie on the image.
    """

    sigma_mm: float
    images: int = 12
    side: int = 7
    overlap: float = 0.5
    least_weight: float = WHOLE


@dataclass(frozen=True)
class CrossingSweeps:
    """Two sweeps' images, reduced.

    Attributes
    ----------
    stacks : tuple of Stack
    frames : tuple of ndarray of int
        Their frame numbers.
    pixel_mm : ndarray, shape (2,)
        Of the images as they were given, across and along the beams.
    unit : float
        Size of the images relative to the usual; lengths of comparison scale with it.
    """

    stacks: tuple[Stack, Stack]
    frames: tuple[IntArray, IntArray]
    pixel_mm: FloatArray
    unit: float
    _cache: dict[tuple[int, float, float], Stack] = field(default_factory=dict, repr=False, compare=False)

    @property
    def centre_mm(self) -> FloatArray:
        """Centre of the first sweep's images, shape (3,)."""
        return self.stacks[0].centre_mm

    def level(self, level: Level, sensor_from_image: RigidTransform) -> Comparison:
        """Comparison of patches all over some images, for calibrations near the given one."""
        sigma, stacks = level.sigma_mm * self.unit, list[Stack]()
        for way, stack in enumerate(self.stacks):
            key, spacing = (way, sigma, level.least_weight), stack.spacing_mm(sensor_from_image)
            if key not in self._cache:
                self._cache[key] = stack.blur(sigma, level.least_weight)
            step, width = max(0.75 * sigma, spacing), max(0.7 * sigma, 0.5 * spacing)
            stacks.append(self._cache[key].resample(sensor_from_image, step, width))
        first, second = (
            spread_patches(stack, evenly(len(stack), level.images), sigma, level.side, level.overlap)
            for stack in stacks
        )
        # Interpolated across: three times the usual distance between images.
        gap = 3.0 * max(stack.spacing_mm(sensor_from_image) for stack in stacks)
        return Comparison((stacks[0], stacks[1]), (first, second), max(2.25 * sigma, gap, 2.0 * self.unit))


def prepare(first: Recording, second: Recording, progress: Progress | None = None) -> CrossingSweeps:
    """Read two crossing sweeps.

    Raises
    ------
    InvalidInputError
        If images do not fit their grid.
    MismatchError
        If the sweeps' images have different pixel sizes or depths: one calibration cannot serve both.
    InsufficientDataError
        If a sweep has too few frames with readings, or its images never change.
    """
    grid = first.grid
    pixels, second_pixels = (
        (sweep.grid.vector_pitch_mm, sweep.grid.sample_spacing_mm, sweep.grid.first_sample_depth_mm)
        for sweep in (first, second)
    )
    if not np.allclose(pixels, second_pixels, rtol=1e-3, atol=1e-6):
        raise MismatchError(
            f"{second.name}: expected the pixels of {first.name}, {{:g}} x {{:g}} mm from {{:g}} mm, got "
            "{:g} x {:g} mm from {:g} mm".format(*pixels, *second_pixels)
        )
    extent = float(np.sqrt(max(grid.width_mm, 1.0) * (grid.depth_mm - grid.first_sample_depth_mm)))
    unit = float(np.clip(extent / USUAL_EXTENT_MM, 0.5, 4.0))
    (stack, frames), (second_stack, second_frames) = (
        read_stack(sweep, BASE_PIXEL_MM * unit, progress) for sweep in (first, second)
    )
    return CrossingSweeps((stack, second_stack), (frames, second_frames), first.pixel_mm, unit)


def evenly(count: int, number: int) -> IntArray:
    """Indices of `number` images spread evenly over `count`, without the two at the ends."""
    spread = np.linspace(0.5, count - 1.5, min(number, count)).round()
    return np.unique(np.clip(spread, 0, count - 1).astype(np.int64))
