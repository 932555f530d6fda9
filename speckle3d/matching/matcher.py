"""Frames made ready for matching, and frame pairs matched: the work every pair of a sweep shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from speckle3d.core.arrays import BoolArray, Complex64Array, Float32Array, FloatArray
from speckle3d.core.curves import CurveKey
from speckle3d.core.region import Region
from speckle3d.core.sweep import RFSettings, Sweep
from speckle3d.matching.inplane import (
    CoarseMatcher,
    InPlaneMotion,
    InPlaneSettings,
    MatchedPair,
    match_with_each,
)
from speckle3d.matching.intensity import (
    IntensityExtractor,
    IntensitySettings,
    intensity_of,
    two_way_wavenumber,
)
from speckle3d.matching.patches import PatchSettings, lay_patches


class MatchingSettings(BaseModel):
    """What of two frames is correlated once their in-plane motion is known."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    correlate: Literal["echo", "intensity"] = Field(
        "echo",
        description="echo: the complex echo, whose distances reach the Cramer-Rao bound and in which "
        "structure that stays weighs less. intensity: as published. B-mode images hold intensity alone.",
    )


@dataclass(frozen=True)
class Echo:
    """One frame's intensity, shape (vector, sample), and the analytic signal it comes from, if known."""

    intensity: Float32Array
    analytic: Complex64Array | None


@dataclass(frozen=True)
class ReadyFrame:
    """What is kept of a frame while pairs with it may still be measured."""

    usable: BoolArray
    """Patches that may be matched, shape (p,)."""

    image: Float32Array
    """Equalised intensity, shape (vector, sample)."""
    spectrum: Complex64Array
    """For the coarse search."""
    echo: Float32Array | None = None
    """Real and imaginary parts of the equalised echo, shape (2, vector, sample)."""


class FrameMatcher:
    """Prepares the frames of one sweep and matches pairs of them.

    Attributes
    ----------
    laid, patches : PatchGrid
        All that fit on the image, and those that are matched.
    """

    def __init__(
        self,
        sweep: Sweep,
        intensity: IntensitySettings,
        patches: PatchSettings,
        inplane: InPlaneSettings,
        matching: MatchingSettings | None = None,
    ) -> None:
        self.extractor = IntensityExtractor.for_sweep(sweep, intensity)
        self.grid = self.extractor.grid
        self.centre_mm = sweep.grid.centre_mm
        self.laid = lay_patches(self.grid, patches)
        self.patches = self.laid
        self.inplane = inplane
        self._mask = Region(patches.region).mask(self.grid) if patches.region else None
        self._coarse = CoarseMatcher(self.grid, inplane.search_mm)
        rf = sweep.signal if isinstance(sweep.signal, RFSettings) else None
        self.of_echo = rf is not None and (matching or MatchingSettings()).correlate == "echo"
        self._wavenumber = two_way_wavenumber(rf) if rf is not None else 0.0
        self.key = CurveKey(
            sweep.signal,
            self.grid.vector_pitch_mm,
            patches.width_mm,
            patches.height_mm,
            intensity.equalise_mm,
            "echo" if self.of_echo else "intensity",
            intensity.edge_fraction,
            sweep.probe,
        )

    @property
    def at_mm(self) -> FloatArray:
        """Position of the patches from the image's centre, shape (p, 2)."""
        return self.patches.centre_mm - self.centre_mm[:2]

    def keep_depths(self, depth_mm: FloatArray) -> None:
        """Leave out the patches beyond the first and the last of some depths; see `PatchGrid.between`."""
        self.patches = self.laid.between(depth_mm)

    def echo(self, frame: npt.NDArray[Any]) -> Echo:
        """Echo of a frame as read."""
        if not self.of_echo:
            return Echo(self.extractor.intensity(frame), None)
        analytic = self.extractor.analytic(frame)
        return Echo(intensity_of(analytic), analytic)

    def prepare(self, echo: Echo, usable: BoolArray | None = None) -> ReadyFrame:
        """Equalise an echo and transform it for the coarse search.

        Parameters
        ----------
        usable : ndarray of bool, shape (p,), optional
            Patches that may be matched; by default all in the region.
        """
        image, parts = self.equalised(echo)
        kept = self.patches.inside if usable is None else self.patches.inside & usable
        # Only what lies in the region is searched for.
        searched = image if self._mask is None else np.where(self._mask, image, image[self._mask].mean())
        return ReadyFrame(kept, image, self._coarse.spectrum(searched), parts)

    def equalised(self, echo: Echo) -> tuple[Float32Array, Float32Array | None]:
        """Intensity and, where there is phase, echo over their local mean; see `ReadyFrame`."""
        if echo.analytic is None:
            return self.extractor.equalise(echo.intensity), None
        return self.extractor.equalise_echo(echo.analytic, echo.intensity)

    def search(self, fixed: ReadyFrame, moving: ReadyFrame) -> InPlaneMotion:
        """In-plane motion to the nearest sample, looked for over the whole search range."""
        shift = self._coarse.shift(fixed.spectrum, moving.spectrum) * self.patches.spacing_mm
        return InPlaneMotion(float(-shift[0]), float(-shift[1]))

    def match(self, fixed: ReadyFrame, moving: ReadyFrame, start: InPlaneMotion) -> MatchedPair:
        """In-plane motion and correlation of one pair, from a start that is right to about a sample."""
        return self.match_with_each([fixed], moving, [start])[0]

    def match_with_each(
        self, fixed: Sequence[ReadyFrame], moving: ReadyFrame, starts: Sequence[InPlaneMotion]
    ) -> list[MatchedPair]:
        """In-plane motion and correlation of a frame's pairs with some others, from a start for each."""
        theirs = [frame.echo for frame in fixed if frame.echo is not None]
        # The others would pull the motion, too.
        some = moving.usable
        matches = match_with_each(
            [frame.image for frame in fixed],
            moving.image,
            self.patches.among(some),
            starts,
            self.centre_mm,
            self.inplane,
            None if moving.echo is None else (theirs, moving.echo),
            self._wavenumber,
        )
        return [
            match.laid_out(some).among(frame.usable & some)
            for match, frame in zip(matches, fixed, strict=True)
        ]
