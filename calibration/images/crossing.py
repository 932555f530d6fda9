"""Two crossing sweeps prepared once, and how they are compared: how sharp, where, and in which frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from calibration.images.similarity import Comparison, spread_patches, whole_images
from calibration.images.stacks import BASE_PIXEL_MM, WHOLE, Stack, TrackedImages, read_stack
from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.core.errors import MismatchError

Progress = Callable[[str, int, int], None]
"""Called with the stage, and how many of how many of its steps are done."""

USUAL_EXTENT_MM = 40.0
"""Geometric mean of width and depth to which lengths below are matched; others scale with the image."""

LEAST_OVERLAP = 0.3
"""Part of an image that the other sweep must show for the image to count (Wein and Khamene 2008)."""

_HELD_OUT_EVERY = 12
_MOST_HELD_OUT = 8


@dataclass(frozen=True)
class Level:
    """One resolution of comparison, in units of `Crossing.unit`.

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
class Crossing:
    """Two sweeps' images, reduced, with some frames of each held out for a check.

    Attributes
    ----------
    used, held_out : tuple of Stack
    frames_used, frames_held_out : tuple of ndarray of int
        Their frame numbers.
    pixel_mm : ndarray, shape (2,)
        Of the images as they were given, across and along the beams.
    unit : float
        Size of the images relative to the usual; lengths of comparison scale with it.
    """

    used: tuple[Stack, Stack]
    held_out: tuple[Stack, Stack]
    frames_used: tuple[IntArray, IntArray]
    frames_held_out: tuple[IntArray, IntArray]
    pixel_mm: FloatArray
    unit: float
    _kept: dict[tuple[int, float, float, bool], Stack] = field(
        default_factory=dict, repr=False, compare=False
    )

    @property
    def centre_mm(self) -> FloatArray:
        """Centre of the first sweep's images, shape (3,)."""
        return self.used[0].centre_mm

    def level(self, level: Level, sensor_from_image: RigidTransform) -> Comparison:
        """Compare patches all over a number of images, both ways, near a calibration."""
        sigma = level.sigma_mm * self.unit
        thin = self._thinned(sigma, sensor_from_image, level.least_weight)
        patches = [
            spread_patches(stack, evenly(len(stack), level.images), level.side, sigma, level.overlap)
            for stack in thin
        ]
        return Comparison(thin, (patches[0], patches[1]), self._gap(sigma, thin, sensor_from_image))

    def whole(self, sigma_mm: float, images: int, sensor_from_image: RigidTransform) -> Comparison:
        """Compare whole images with what the other sweep shows, as published."""
        sigma = sigma_mm * self.unit
        thin = self._thinned(sigma, sensor_from_image)
        a, b = (whole_images(stack, evenly(len(stack), images), sigma) for stack in thin)
        gap = self._gap(sigma, thin, sensor_from_image)
        return Comparison(thin, (a, b), gap, least_share=LEAST_OVERLAP)

    def check(self, sigma_mm: float, sensor_from_image: RigidTransform) -> Comparison:
        """Compare the images held out with cuts of the other sweep, from which its own are left out too."""
        sigma = sigma_mm * self.unit
        thin = self._thinned(sigma, sensor_from_image)
        held = (
            self._blurred(0, sigma, held_out=True),
            self._blurred(1, sigma, held_out=True),
        )
        a, b = (whole_images(stack, np.arange(len(stack)), sigma) for stack in held)
        gap = self._gap(sigma, thin, sensor_from_image)
        return Comparison(held, (a, b), gap, sources=thin, least_share=LEAST_OVERLAP)

    def published(self, images: int) -> Comparison:
        """Compare whole images as they are with cuts of all of the other sweep's."""
        fine = self._blurred(0, 0.5 * self.unit), self._blurred(1, 0.5 * self.unit)
        a, b = (whole_images(stack, evenly(len(stack), images), 0.7 * self.unit) for stack in fine)
        return Comparison(fine, (a, b), max(2.0 * self.unit, 2.0), least_share=LEAST_OVERLAP)

    def _thinned(
        self, sigma_mm: float, sensor_from_image: RigidTransform, least_weight: float = WHOLE
    ) -> tuple[Stack, Stack]:
        spacing = [frame_spacing(stack, sensor_from_image) for stack in self.used]
        a, b = (
            self._blurred(way, sigma_mm, least_weight).thinned(
                sensor_from_image,
                max(0.75 * sigma_mm, spacing[way]),
                max(0.7 * sigma_mm, 0.5 * spacing[way]),
            )
            for way in (0, 1)
        )
        return a, b

    def _blurred(
        self, way: int, sigma_mm: float, least_weight: float = WHOLE, held_out: bool = False
    ) -> Stack:
        key = way, sigma_mm, least_weight, held_out
        if key not in self._kept:
            self._kept[key] = (self.held_out if held_out else self.used)[way].blurred(sigma_mm, least_weight)
        return self._kept[key]

    def _gap(self, sigma_mm: float, stacks: tuple[Stack, Stack], sensor_from_image: RigidTransform) -> float:
        """Gap that is still interpolated across: three of the usual distances between images."""
        spacing = max(frame_spacing(stack, sensor_from_image) for stack in stacks)
        return max(2.25 * sigma_mm, 3.0 * spacing, 2.0 * self.unit)


def prepare(first: TrackedImages, second: TrackedImages, progress: Progress | None = None) -> Crossing:
    """Read two crossing sweeps and set some frames aside.

    Raises
    ------
    InvalidInputError
        If images do not fit their grid.
    MismatchError
        If the sweeps' images have different pixel sizes or depths: one calibration cannot serve both.
    InsufficientDataError
        If a sweep has too few frames with readings, or its images never change.
    """
    _require_one_scanner(first, second)
    grid = first.grid
    extent = float(np.sqrt(max(grid.width_mm, 1.0) * (grid.depth_mm - grid.first_sample_depth_mm)))
    unit = float(np.clip(extent / USUAL_EXTENT_MM, 0.5, 4.0))
    stacks, numbers = [], []
    for tracked in (first, second):
        step = None if progress is None else _step_of(progress, f"reading {tracked.name}")
        stack, frames = read_stack(tracked, BASE_PIXEL_MM * unit, step)
        stacks.append(stack)
        numbers.append(frames)
    aside = [_set_aside(len(stack)) for stack in stacks]
    kept = [np.setdiff1d(np.arange(len(s)), out) for s, out in zip(stacks, aside, strict=True)]
    return Crossing(
        (stacks[0][kept[0]], stacks[1][kept[1]]),
        (stacks[0][aside[0]], stacks[1][aside[1]]),
        (numbers[0][kept[0]], numbers[1][kept[1]]),
        (numbers[0][aside[0]], numbers[1][aside[1]]),
        np.array([grid.vector_pitch_mm, grid.sample_spacing_mm]),
        unit,
    )


def evenly(count: int, wanted: int) -> IntArray:
    """Numbers of `wanted` images, spread over all `count` but for the two at the ends."""
    spread = np.linspace(0.5, count - 1.5, min(wanted, count)).round()
    return np.unique(np.clip(spread, 0, count - 1).astype(np.int64))


def frame_spacing(stack: Stack, sensor_from_image: RigidTransform) -> float:
    """Usual distance between neighbouring images, mm, pauses aside."""
    way = stack.travelled(sensor_from_image)
    return float(way[-1] / max(len(way) - 1, 1))


def _set_aside(count: int) -> IntArray:
    wanted = min(_MOST_HELD_OUT, max(1, count // _HELD_OUT_EVERY))
    return np.unique((np.arange(1, 2 * wanted, 2) * count / (2.0 * wanted)).astype(np.int64))


def _step_of(progress: Progress, stage: str) -> Callable[[int, int], None]:
    return lambda done, total: progress(stage, done, total)


def _require_one_scanner(first: TrackedImages, second: TrackedImages) -> None:
    a, b = (
        np.array([t.grid.vector_pitch_mm, t.grid.sample_spacing_mm, t.grid.first_sample_depth_mm])
        for t in (first, second)
    )
    if not np.allclose(a, b, rtol=1e-3, atol=1e-6):
        raise MismatchError(
            f"{second.name}: expected the pixels of {first.name}, {a[0]:g} x {a[1]:g} mm from {a[2]:g} mm, "
            f"got {b[0]:g} x {b[1]:g} mm from {b[2]:g} mm"
        )
