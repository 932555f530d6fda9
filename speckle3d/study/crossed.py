"""The crossing sweep of a job: tracked after the first, and crossed with it."""

from __future__ import annotations

from speckle3d.config import Config
from speckle3d.core.arrays import Float32Array
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.progress import Progress, after
from speckle3d.core.sweep import Sweep
from speckle3d.correction.crossing.pair import CrossedPair, crossed
from speckle3d.crossing_sweeps import crossing_side, curves_from, require_pair, stack_for
from speckle3d.matching.frames import ImageSink
from speckle3d.pipeline import Tracked, track


class Companion:
    """A second sweep over the tissue of the one that is reconstructed.

    Parameters
    ----------
    first, second : Sweep
    curves : DecorrelationCurves
    config : Config
    """

    def __init__(self, first: Sweep, second: Sweep, curves: DecorrelationCurves, config: Config) -> None:
        require_pair(first, second)
        self.first, self.second, self._curves, self._config = first, second, curves, config
        self._stacks = stack_for(first, config), stack_for(second, config)
        self._tracked: Tracked | None = None

    @property
    def frames(self) -> int:
        """Of both sweeps."""
        return len(self.first) + len(self.second)

    def beside(self, sink: ImageSink) -> ImageSink:
        """Keep what crossing needs of the first sweep's images beside what another sink keeps."""
        stack = self._stacks[0]

        def keep(index: int, intensity: Float32Array) -> None:
            sink(index, intensity)
            stack.keep(index, intensity)

        return keep

    def cross(self, tracked: Tracked, progress: Progress | None) -> tuple[CrossedPair | None, str]:
        """Track the second sweep and cross it with the first, which is tracked; or say why that fails."""
        shown = after(progress, len(self.first), self.frames)
        try:
            self._tracked = track(self.second, self._curves, self._config, shown, images=self._stacks[1].keep)
            sides = [
                crossing_side(sweep, each, stack, self._config)
                for sweep, each, stack in zip(
                    (self.first, self.second), (tracked, self._tracked), self._stacks, strict=True
                )
            ]
            return crossed(sides[0], sides[1], self._config.crossing), ""
        except (InsufficientDataError, MismatchError) as error:
            return None, f"{self.first.name}: drift mode crossed: {error}"

    def curves(self, tracked: Tracked, pair: CrossedPair) -> DecorrelationCurves:
        """The curves, corrected by what the crossing says of both sweeps' lengths."""
        assert self._tracked is not None
        return curves_from((tracked, self._tracked), pair, self._curves)
