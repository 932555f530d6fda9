"""What is wrong with frames, and why, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import IntArray
from speckle3d.core.doubts import Doubt
from speckle3d.core.reconstruction import Reconstruction
from speckle3d.core.sweep import BModeSettings, Sweep, read_frame
from speckle3d.examine.sensors import doubts_of_readings
from speckle3d.matching.intensity import IntensityExtractor
from speckle3d.matching.patches import lay_patches
from speckle3d.matching.quality import FrameFeatures, FrameFlag, FrameInspector, flag_frames

NAMES = {
    FrameFlag.FROZEN: "frozen",
    FrameFlag.SATURATED: "saturated",
    FrameFlag.LIFTED: "lifted",
    FrameFlag.NO_SPECKLE: "no speckle",
    FrameFlag.UNMATCHED: "unmatched",
}


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
        self._sweep, self._settings = sweep, config
        self._found: list[FrameFeatures] = []
        self._of_frame: dict[int, FrameFeatures] = {}
        self._inspector: FrameInspector | None = None
        self._extractor: IntensityExtractor | None = None
        trust = None if reconstruction is None else reconstruction.trust
        self.flags: IntArray | None = None if trust is None else trust.flags
        self._are_kept = trust is not None
        self.doubts = doubts_of_readings(sweep) if doubts is None else tuple(doubts)
        self.are_of_reconstruction = doubts is not None

    @property
    def judged(self) -> int:
        """Frames that have been looked at; all, if the reconstruction's flags are shown."""
        return len(self._sweep) if self.flags is not None else len(self._found)

    def judge_next(self) -> None:
        """Look at one more frame; after the last all have their flags."""
        if self.flags is not None:
            return
        self._found.append(self.features(len(self._found)))
        if len(self._found) == len(self._sweep):
            self.flags = flag_frames(self._found, self._settings.quality)

    def features(self, frame: int) -> FrameFeatures:
        """What is measured of a frame."""
        if frame not in self._of_frame:
            if self._inspector is None or self._extractor is None:
                self._extractor = IntensityExtractor.for_sweep(self._sweep, self._settings.intensity)
                patches = lay_patches(self._extractor.grid, self._settings.patches)
                self._inspector = FrameInspector(self._sweep.signal, patches, self._settings.quality)
            samples = read_frame(self._sweep.frames, frame)
            self._of_frame[frame] = self._inspector.inspect(samples, self._extractor.intensity(samples))
        return self._of_frame[frame]

    def reasons(self, frame: int) -> list[str]:
        """Why a frame has its flags, a line each; none for a frame without."""
        if self.flags is None or not self.flags[frame]:
            return []
        return list(self._reasons(FrameFlag(int(self.flags[frame])), frame))

    def _reasons(self, flags: FrameFlag, frame: int) -> Iterator[str]:
        quality = self._settings.quality
        seen = self.features(frame)
        if flags & FrameFlag.FROZEN:
            yield f"frozen: bit for bit frame {frame - 1}, which the recorder repeated"
        if flags & FrameFlag.SATURATED:
            limit = quality.clipped_bmode if self._is_bmode else quality.clipped_rf
            yield (
                f"saturated: {100 * seen.clipped * limit:.2g} % of its samples are clipped, "
                f"from {100 * limit:.2g} % on correlations cannot be trusted"
            )
        speckle = f"{100 * seen.speckle_share:.0f} % of its patches hold speckle, expected at least "
        speckle += f"{100 * quality.speckle_share:.0f} %"
        if flags & FrameFlag.LIFTED:
            few = seen.speckle_share < quality.speckle_share
            noise = f"{speckle}, and {100 * seen.noise_share:.0f} % noise alone"
            fainter = f"its echoes are at least {quality.drop_db:g} dB fainter than those of the sound frames"
            yield f"lifted: no contact: {noise if few else fainter}"
        if flags & FrameFlag.NO_SPECKLE:
            yield f"no speckle: {speckle}"
        if flags & FrameFlag.UNMATCHED:
            least = self._settings.trajectory.least_correlation
            yield (
                f"unmatched: no earlier frame correlates with it to {least:g} in the median patch: "
                "too fast, lifted, or frames lost"
            )

    @property
    def _is_bmode(self) -> bool:
        return isinstance(self._sweep.signal, BModeSettings)

    def state(self) -> str:
        """Where flags are from and how many there are, in a line."""
        total = len(self._sweep)
        if self.flags is None:
            return f"Looking for frames that cannot be used: {len(self._found)} of {total}"
        flagged = int(np.count_nonzero(self.flags))
        alone = "each frame looked at by itself; a reconstruction also flags those unlike all earlier ones"
        source = "as its reconstruction was made" if self._are_kept else alone
        below = ", orange below" if flagged else ""
        return f"{flagged or 'None'} of {total} frames flagged{below} ({source})."
