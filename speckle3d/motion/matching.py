"""Frames made ready for matching, and frame pairs matched: the work every pair of a sweep shares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.curves import CurveKey
from speckle3d.core.sweep import Sweep
from speckle3d.motion.inplane import CoarseMatcher, InPlaneMotion, InPlaneSettings, PatchMatch, match_patches
from speckle3d.motion.intensity import (
    Complex64Array,
    Float32Array,
    IntensityExtractor,
    IntensitySettings,
)
from speckle3d.motion.patches import PatchSettings, lay_patches


@dataclass(frozen=True)
class ReadyFrame:
    """What is kept of a frame while pairs with it may still be measured."""

    image: Float32Array
    """Equalised intensity, shape (vector, sample)."""
    spectrum: Complex64Array
    """For the coarse search."""


class FrameMatcher:
    """Prepares the frames of one sweep and matches pairs of them."""

    def __init__(
        self, sweep: Sweep, intensity: IntensitySettings, patches: PatchSettings, inplane: InPlaneSettings
    ) -> None:
        self.extractor = IntensityExtractor.for_sweep(sweep, intensity)
        self.grid = self.extractor.grid
        self.centre_mm = sweep.grid.centre_mm
        self.patches = lay_patches(self.grid, patches)
        self.at_mm = self.patches.centre_mm - self.centre_mm[:2]
        self.inplane = inplane
        self._coarse = CoarseMatcher(self.grid, inplane.search_mm)
        self.key = CurveKey(
            sweep.signal,
            self.grid.vector_pitch_mm,
            patches.width_mm,
            patches.height_mm,
            intensity.equalise_mm,
        )

    def intensity(self, frame: npt.NDArray[Any]) -> Float32Array:
        """Echo intensity of a frame as read, shape (vector, grid.samples)."""
        return self.extractor.intensity(frame)

    def prepare(self, intensity: Float32Array) -> ReadyFrame:
        """Equalise an intensity image and transform it for the coarse search."""
        image = self.extractor.equalise(intensity)
        return ReadyFrame(image, self._coarse.spectrum(image))

    def search(self, fixed: ReadyFrame, moving: ReadyFrame) -> InPlaneMotion:
        """In-plane motion to the nearest sample, looked for over the whole search range."""
        shift = self._coarse.shift(fixed.spectrum, moving.spectrum) * self.patches.spacing_mm
        return InPlaneMotion(float(-shift[0]), float(-shift[1]))

    def match(self, fixed: ReadyFrame, moving: ReadyFrame, start: InPlaneMotion) -> PatchMatch:
        """In-plane motion and correlation of one pair, from a start that is right to about a sample."""
        return match_patches(fixed.image, moving.image, self.patches, start, self.centre_mm, self.inplane)


def compose(first: InPlaneMotion, then: InPlaneMotion) -> InPlaneMotion:
    """In-plane motion over two steps, as a start for matching across both."""
    c, s = np.cos(first.roll_rad), np.sin(first.roll_rad)
    return InPlaneMotion(
        first.x_mm + c * then.x_mm - s * then.y_mm,
        first.y_mm + s * then.x_mm + c * then.y_mm,
        first.roll_rad + then.roll_rad,
    )


def inverse(motion: InPlaneMotion) -> InPlaneMotion:
    """In-plane motion the other way round."""
    c, s = np.cos(motion.roll_rad), np.sin(motion.roll_rad)
    return InPlaneMotion(
        -c * motion.x_mm - s * motion.y_mm, s * motion.x_mm - c * motion.y_mm, -motion.roll_rad
    )
