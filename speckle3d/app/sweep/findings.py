"""What is wrong with frames, and why, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import IntArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import BModeSettings, Sweep, read_frame
from speckle3d.examine.sensors import cleaned_readings
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.matching.patches import PatchGrid, lay_patches
from speckle3d.matching.quality import FrameFeatures, FrameFlag, flag_frames, inspect_frame

NAMES = {flag: (flag.name or "").lower().replace("_", " ") for flag in FrameFlag}


class FrameFindings:
    """Flags of frames, what is measured of each, and what is doubted of the recording.

    Parameters
    ----------
    sweep : Sweep
    config : Config
        With which frames are judged.
    reconstruction : Reconstruction, optional
        Whose flags are shown. Without one frames are judged here, each by itself and by the others, but not
        by what they have in common.
    doubts : sequence of Doubt, optional
        As they were found with the reconstruction; None if that is not known.
    """

    def __init__(
        self,
        sweep: Sweep,
        config: Config,
        reconstruction: Reconstruction | None,
        doubts: Sequence[Doubt] | None,
    ) -> None:
        self._sweep, self._config = sweep, config
        self._features: list[FrameFeatures] = []
        trust = None if reconstruction is None else reconstruction.trust
        self.flags: IntArray | None = None if trust is None else trust.flags
        self.doubts = cleaned_readings(sweep)[1] if doubts is None else tuple(doubts)
        self.features = lru_cache(len(sweep))(self._inspect)

    def judge_next(self) -> None:
        """Look at one more frame; after the last all have their flags."""
        if self.flags is None:
            self._features.append(self.features(len(self._features)))
            if len(self._features) == len(self._sweep):
                self.flags = flag_frames(self._features, self._config.quality)

    @cached_property
    def _looks(self) -> tuple[IntensityExtractor, PatchGrid]:
        extractor = IntensityExtractor(self._sweep.signal, self._sweep.grid, self._config.intensity)
        return extractor, lay_patches(extractor.grid, self._config.patches)

    def _inspect(self, frame: int) -> FrameFeatures:
        extractor, patches = self._looks
        samples = read_frame(self._sweep.frames, frame)
        is_bmode = isinstance(self._sweep.signal, BModeSettings)
        return inspect_frame(samples, extractor.intensity(samples), patches, is_bmode, self._config.quality)

    def reasons(self, frame: int) -> list[str]:
        """Why a frame has its flags, a line each; none for a frame without."""
        if self.flags is None or not self.flags[frame]:
            return []
        return list(self._reasons(FrameFlag(int(self.flags[frame])), frame))

    def _reasons(self, flags: FrameFlag, frame: int) -> Iterator[str]:
        quality, seen = self._config.quality, self.features(frame)
        speckle = (
            f"{100 * seen.speckle_share:.0f} % of its patches hold speckle, expected at least "
            f"{100 * quality.speckle_share:.0f} %"
        )
        if flags & FrameFlag.FROZEN:
            yield f"frozen: bit for bit frame {frame - 1}, which the recorder repeated"
        if flags & FrameFlag.SATURATED:
            is_bmode = isinstance(self._sweep.signal, BModeSettings)
            limit = quality.clipped_bmode if is_bmode else quality.clipped_rf
            share = f"{100 * seen.clipped * limit:.2g} % of its samples are clipped"
            yield f"saturated: {share}, from {100 * limit:.2g} % on correlations cannot be trusted"
        if flags & FrameFlag.LIFTED:
            yield f"lifted: no contact: {speckle}, and {100 * seen.noise_share:.0f} % noise alone"
        if flags & FrameFlag.NO_SPECKLE:
            yield f"no speckle: {speckle}"
        if flags & FrameFlag.UNMATCHED:
            least = self._config.trajectory.least_correlation
            yield f"unmatched: no earlier frame correlates with it to {least:g}: too fast, or frames lost"

    def state(self) -> str:
        """How many frames are flagged, in a line."""
        total = len(self._sweep)
        if self.flags is None:
            return f"Looking for frames that cannot be used: {len(self._features)} of {total}"
        return f"{np.count_nonzero(self.flags) or 'None'} of {total} frames flagged."
