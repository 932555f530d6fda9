"""Flags of frames and doubts about a recording, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import IntArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import Sweep
from speckle3d.examine.sensors import repair_readings
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.quality import FrameFeatures, FrameFlag, flag_frames

REASONS = {
    FrameFlag.FROZEN: "bit for bit the frame before, which the recorder repeated",
    FrameFlag.SATURATED: "so many samples are clipped that correlations cannot be trusted",
    FrameFlag.LIFTED: "no contact: noise alone",
    FrameFlag.NO_SPECKLE: "too few patches hold speckle",
    FrameFlag.UNMATCHED: "no earlier frame correlates with it: too fast, or frames lost",
}


def name_of(flag: FrameFlag) -> str:
    """What a flag is called on the page."""
    return str(flag.name).lower().replace("_", " ")


class FrameFindings:
    """Flags of frames, and what is doubted of the recording.

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
        self._sweep, self._quality = sweep, config.quality
        self._features: list[FrameFeatures] = []
        trust = None if reconstruction is None else reconstruction.trust
        self.flags: IntArray | None = None if trust is None else trust.flags
        self.doubts = repair_readings(sweep)[1] if doubts is None else tuple(doubts)
        if trust is None:
            self._matcher = FrameMatcher(sweep, config)

    def judge_next(self) -> None:
        """Look at one more frame; after the last all have their flags."""
        samples = self._sweep.frames[len(self._features)]
        self._features.append(self._matcher.ready(samples).features)
        if len(self._features) == len(self._sweep):
            self.flags = flag_frames(self._features, self._quality)

    def reasons(self, frame: int) -> list[str]:
        """Why a frame has its flags, a line each; none for a frame without."""
        flags = FrameFlag(0 if self.flags is None else int(self.flags[frame]))
        return [f"{name_of(flag)}: {REASONS[flag]}" for flag in flags]

    def state(self) -> str:
        """How many frames are flagged, in a line."""
        total = len(self._sweep)
        if self.flags is None:
            return f"Looking for frames that cannot be used: {len(self._features)} of {total}"
        return f"{np.count_nonzero(self.flags) or 'None'} of {total} frames flagged."
