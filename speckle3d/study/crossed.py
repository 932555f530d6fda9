"""The crossing sweep of a job: tracked after the first, and crossed with it."""

from __future__ import annotations

from speckle3d.config import Config
from speckle3d.core.arrays import Float32Array
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.progress import Progress, after
from speckle3d.core.sweep import Sweep
from speckle3d.correction.crossing.pair import CrossedPair, crossed
from speckle3d.crossing_sweeps import crossing_side, curves_from, require_pair, stack_for
from speckle3d.pipeline import Tracked, track


class Companion:
    """A second sweep over the tissue of the one that is reconstructed.

    Parameters
    ----------
    sweeps : tuple of Sweep
        The one that is reconstructed, and the other.
    curves : DecorrelationCurves
    config : Config
    """

    def __init__(self, sweeps: tuple[Sweep, Sweep], curves: DecorrelationCurves, config: Config) -> None:
        require_pair(*sweeps)
        self._sweeps, self._curves, self._config = sweeps, curves, config
        self._stacks = [stack_for(sweep, config) for sweep in sweeps]

    def keep(self, index: int, intensity: Float32Array) -> None:
        """Keep what crossing needs of an image of the first sweep."""
        self._stacks[0].keep(index, intensity)

    def cross(self, tracked: Tracked, progress: Progress | None) -> tuple[CrossedPair, DecorrelationCurves]:
        """Track the second sweep and cross it with the first, which is tracked; the curves corrected by it.

        Raises
        ------
        MismatchError, InsufficientDataError
            As `cross_sweeps`.
        """
        first, second = self._sweeps
        shown = after(progress, len(first), len(first) + len(second))
        both = tracked, track(second, self._curves, self._config, shown, images=self._stacks[1].keep)
        sides = [
            crossing_side(sweep, each, stack, self._config)
            for sweep, each, stack in zip(self._sweeps, both, self._stacks, strict=True)
        ]
        pair = crossed(sides[0], sides[1], self._config.crossing)
        return pair, curves_from(both, pair, self._curves)
