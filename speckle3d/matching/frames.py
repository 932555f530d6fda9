"""Frames of a sweep matched, one after the other, with the earlier ones that the schedule wants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray
from speckle3d.core.sweep import BModeSettings, Sweep, read_frame
from speckle3d.core.threads import ahead
from speckle3d.matching.inplane import InPlaneMotion, MatchedPair, compose, inverse
from speckle3d.matching.matcher import Echo, FrameMatcher, ReadyFrame
from speckle3d.matching.quality import DrawnOver, FrameFeatures, FrameInspector, QualitySettings
from speckle3d.matching.schedule import Schedule
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import FRAMES, Texture, spread_frames

SEARCHED = 3
"""References against which the in-plane motion of a frame is searched, if it resembles none before."""
ImageSink = Callable[[int, Float32Array], None]
"""Called with each frame's number and intensity image (vector, sample), in order."""


@dataclass(frozen=True)
class MatchedSweep:
    """All that later stages need of a sweep's images.

    Attributes
    ----------
    table : CorrelationTable
        All pairs, sorted by second frame, then by first.
    features : sequence of FrameFeatures
        Of every frame.
    texture : Texture
        Of some frames.
    left_out : ndarray, shape (p,)
        Share of the frames in which each patch in the region holds no echo that could be matched: shadow,
        noise, no contact, or something drawn on the image.
    """

    table: CorrelationTable
    features: Sequence[FrameFeatures]
    texture: Texture
    left_out: FloatArray
    drawn: BoolArray
    """Patches that something is drawn on, shape (p,)."""

    @property
    def usable(self) -> list[BoolArray]:
        """Patches of each frame that may be matched, shape (p,)."""
        return [features.usable & ~self.drawn for features in self.features]


def match_sweep(
    sweep: Sweep,
    matcher: FrameMatcher,
    schedule: Schedule,
    quality: QualitySettings,
    progress: Callable[[int, int], None] | None = None,
    images: ImageSink | None = None,
    textures: int = FRAMES,
) -> MatchedSweep:
    """Match every frame of a sweep with the earlier ones that the schedule wants.

    Parameters
    ----------
    progress : callable, optional
        Called with frames done and frames in all.
    images : callable, optional
        Called with every intensity image.
    textures : int
        Frames whose texture is measured.
    """
    maker, matched = FrameMaker(sweep, matcher, quality), FrameByFrame(matcher, schedule)
    texture, chosen = Texture(sweep.signal, matcher), spread_frames(len(sweep), textures)
    features: list[FrameFeatures] = []
    drawn = DrawnOver(matcher.patches) if isinstance(sweep.signal, BModeSettings) else None

    def make(number: int) -> tuple[int, MadeReady]:
        frame = read_frame(sweep.frames, number)
        made = maker.make(frame)
        if drawn:
            drawn.keep(frame)
        if number in chosen:
            texture.keep(number, made.echo, made.features.usable)
        return number, made

    def pairs() -> Iterator[tuple[int, int, MatchedPair]]:
        for number, made in ahead(make, range(len(sweep))):
            if images:
                images(number, made.echo.intensity)
            features.append(made.features)
            matches = matched.advance(number, made.ready)
            yield from ((first, number, matches[first]) for first in sorted(matches))
            if progress:
                progress(number + 1, len(sweep))

    table = CorrelationTable.of(pairs(), len(matcher.patches))
    over = drawn.patches if drawn else np.zeros(len(matcher.patches), dtype=bool)
    left_out = matcher.patches.inside - np.mean([f.usable & ~over for f in features], axis=0)
    return MatchedSweep(table.among(~over), features, texture, left_out, over)


@dataclass(frozen=True)
class MadeReady:
    """What is made of a frame on the way to matching it."""

    echo: Echo
    ready: ReadyFrame
    features: FrameFeatures


class FrameMaker:
    """Makes frames of one sweep ready to be matched, each by itself and on any thread."""

    def __init__(self, sweep: Sweep, matcher: FrameMatcher, quality: QualitySettings) -> None:
        self._matcher = matcher
        self._inspector = FrameInspector(sweep.signal, matcher.patches, quality)

    def make(self, frame: npt.NDArray[Any]) -> MadeReady:
        """Make one frame ready; `frame` as read, shape (vector, sample)."""
        echo = self._matcher.echo(frame)
        features = self._inspector.inspect(frame, echo.intensity)
        return MadeReady(echo, self._matcher.prepare(echo, features.usable), features)


class FrameByFrame:
    """Matches frames in order; keeps those that later ones are still to be matched with."""

    def __init__(self, matcher: FrameMatcher, schedule: Schedule) -> None:
        self._matcher, self._schedule = matcher, schedule
        self._ready: dict[int, ReadyFrame] = {}
        self._motion: dict[int, InPlaneMotion] = {0: InPlaneMotion()}

    def advance(self, frame: int, ready: ReadyFrame) -> dict[int, MatchedPair]:
        """Match a frame with the earlier ones that the schedule wants, latest first.

        Parameters
        ----------
        frame : int
            The number after that of the frame before.
        """
        self._ready[frame] = ready
        pairs = self._pairs(frame)
        self._schedule.settle(frame, {first: pair.median for first, pair in pairs.items()})
        keep = self._schedule.needed(frame)
        self._ready = {k: v for k, v in self._ready.items() if k in keep}
        self._motion = {k: v for k, v in self._motion.items() if k in keep}
        return pairs

    def _pairs(self, frame: int) -> dict[int, MatchedPair]:
        """Match a frame with its references, from a start found against the first that it resembles."""
        references = self._schedule.references(frame)
        pairs: dict[int, MatchedPair] = {}
        for anchor in references[:SEARCHED]:
            start = self._matcher.search(self._ready[anchor], self._ready[frame])
            self._motion[frame] = compose(self._motion[anchor], start)
            pairs = self._match(references, frame)
            if max(pair.median for pair in pairs.values()) >= self._schedule.least_correlation:
                break
        else:
            if references:
                self._motion[frame] = self._motion[frame - 1]
        return pairs

    def _match(self, references: Sequence[int], frame: int) -> dict[int, MatchedPair]:
        """Match a frame with its references, those after its predecessor from the motion found with that."""
        before = frame - 1
        split = references.index(before) + 1 if before in references else len(references)
        pairs: dict[int, MatchedPair] = {}
        for some in filter(None, (references[:split], references[split:])):
            starts = [compose(inverse(self._motion[first]), self._motion[frame]) for first in some]
            fixed = [self._ready[first] for first in some]
            pairs |= zip(some, self._matcher.match_with_each(fixed, self._ready[frame], starts), strict=True)
            if some[-1] == before and pairs[before].median >= self._schedule.least_correlation:
                self._motion[frame] = compose(self._motion[before], pairs[before].motion)
        return pairs
