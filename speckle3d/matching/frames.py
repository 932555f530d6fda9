"""Match the frames of a sweep, one after the other, with earlier ones of a schedule."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.core.sweep import Sweep
from speckle3d.core.threads import ahead
from speckle3d.kernels.inplane import Frame
from speckle3d.matching.matcher import FrameMatcher, compose, inverse
from speckle3d.matching.quality import FrameFeatures, FrameFlag, flag_frames, short_repeats
from speckle3d.matching.schedule import KnownSchedule, PairSchedule
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import Texture, leave_out_standing

ImageSink = Callable[[int, Float32Array], None]
"""Called with each frame's number and intensity image (vector, sample), in order."""


@dataclass(frozen=True)
class MatchedSweep:
    """Result of matching a sweep: table of correlations, quality of frames, texture.

    Attributes
    ----------
    table : CorrelationTable
        All pairs, sorted by second frame, then by first.
    features : sequence of FrameFeatures
        Of every frame.
    texture : Texture
        Of the usable patches of some frames.
    flags : ndarray of int, shape (n,)
        `FrameFlag` of every frame, by what is in it and what it shares with others.
    echoless : ndarray, shape (p,)
        Share of the frames in which each patch in the region holds no echo that could be matched: shadow,
        noise, no contact, or something drawn on the image.
    """

    table: CorrelationTable
    features: Sequence[FrameFeatures]
    texture: Texture
    flags: IntArray
    echoless: FloatArray

    @property
    def repeats(self) -> IntArray:
        """Frames with the image of the one before, by a recorder that is faster than the scanner."""
        return np.flatnonzero(short_repeats(self.flags))

    @property
    def sound(self) -> BoolArray:
        """Pairs both of whose frames hold speckle, shape (e,)."""
        return self.table.joins((self.flags & ~FrameFlag.UNMATCHED) == 0)


def match_sweep(
    sweep: Sweep,
    matcher: FrameMatcher,
    schedule: PairSchedule | KnownSchedule,
    progress: Callable[[int, int], None] | None = None,
    images: ImageSink | None = None,
) -> MatchedSweep:
    """Match every frame of a sweep with the earlier ones of the schedule.

    Parameters
    ----------
    progress : callable, optional
        Called with frames done and frames in all.
    images : callable, optional
        Called with every intensity image.
    """
    pairing, texture = FrameByFrame(matcher, schedule), Texture(matcher)
    texture_frames = leave_out_standing(sweep, matcher)
    features, tables = [], []
    frames = ahead(lambda number: matcher.ready(sweep.frames[number]), range(len(sweep)))
    for number, ready in enumerate(frames):
        if number in texture_frames:
            texture.keep(number, ready)
        if images:
            images(number, ready.echo.intensity)
        features.append(ready.features)
        tables.append(pairing.advance(number, ready.frame))
        if progress:
            progress(number + 1, len(sweep))
    table, flags = CorrelationTable.joined(tables), flag_frames(features, matcher.quality)
    flags[table.unmatched(len(sweep), schedule.least_correlation)] |= FrameFlag.UNMATCHED
    echoless = matcher.patches.inside - np.mean([frame.usable for frame in features], axis=0)
    return MatchedSweep(table, features, texture, flags, echoless)


class FrameByFrame:
    """Matches frames in order; keeps those that later ones are still to be matched with."""

    def __init__(self, matcher: FrameMatcher, schedule: PairSchedule | KnownSchedule) -> None:
        self._matcher, self._schedule = matcher, schedule
        self._frames: dict[int, tuple[Frame, FloatArray]] = {}
        self._motion = np.zeros(3)

    def advance(self, number: int, frame: Frame) -> CorrelationTable:
        """Match a frame with the earlier ones of the schedule; pairs by increasing first frame.

        Parameters
        ----------
        number : int
            That after the number of the frame before.
        """
        table = self._pairs(number, frame)
        self._schedule.settle(number, dict(zip(table.first.tolist(), table.median.tolist(), strict=True)))
        self._frames[number] = frame, self._motion
        self._frames = {k: self._frames[k] for k in self._schedule.needed(number) if k in self._frames}
        return table

    def _pairs(self, number: int, frame: Frame) -> CorrelationTable:
        """Match a frame with its references, from a start found against the first that it resembles."""
        references, least = self._schedule.references(number), self._schedule.least_correlation
        fixed = {first: self._frames[first][0] for first in sorted(references)}
        table = self._matcher.match({}, number, frame, [])
        # The last sound frame may show other tissue, or be the first of the sweep, and without an echo.
        for anchor in references:
            before = self._frames[anchor][1]
            motion = compose(before, self._matcher.search(fixed[anchor], frame))
            starts = [compose(inverse(self._frames[first][1]), motion) for first in fixed]
            table = self._matcher.match(fixed, number, frame, starts)
            if table.median.max() >= least:
                row = list(fixed).index(anchor)
                close = table.median[row] >= least
                self._motion = compose(before, table.inplane[row]) if close else motion
                break
        return table
