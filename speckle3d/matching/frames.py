"""Frames of a sweep matched, one after the other, with the earlier ones that the schedule wants."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy.typing as npt

from speckle3d.core.arrays import Float32Array
from speckle3d.core.sweep import BModeSettings, RFSettings, Sweep, read_frame
from speckle3d.core.threads import ahead, counting_seconds
from speckle3d.matching.inplane import InPlaneMotion
from speckle3d.matching.matcher import FrameMatcher, ReadyFrame, compose, inverse
from speckle3d.matching.quality import FrameFeatures, FrameInspector, QualitySettings
from speckle3d.matching.schedule import PairSchedule, TrajectorySettings
from speckle3d.matching.table import CorrelationTable, MatchedPair

SEARCHED = 3
"""References against which the in-plane motion of a frame is searched, if it resembles none before."""
AHEAD = 3
"""Frames made ready before they are asked for."""
MATCHING = "in-plane motion and correlation"
"""Name of the stage in `StageTimes`."""
ImageSink = Callable[[int, Float32Array], None]
"""Called with each frame's number and intensity image (vector, sample), in order."""


@dataclass
class StageTimes:
    """Time spent in each stage; reading and intensity overlap with the rest on other cores.

    Attributes
    ----------
    seconds : dict
        By stage: what its threads spent from beginning to end, waits included.
    processor_seconds : dict
        By stage: what processors spent on it.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    processor_seconds: dict[str, float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Add the time spent inside to a stage's."""
        then = time.perf_counter()
        with counting_seconds() as spent:
            try:
                yield
            finally:
                took = time.perf_counter() - then
        with self._lock:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + took
            self.processor_seconds[stage] = self.processor_seconds.get(stage, 0.0) + sum(spent)


@dataclass(frozen=True)
class MatchedSweep:
    """All pairs of a sweep, sorted by second frame, then by first, and the features of every frame."""

    table: CorrelationTable
    features: Sequence[FrameFeatures]


def match_sweep(
    sweep: Sweep,
    matcher: FrameMatcher,
    trajectory: TrajectorySettings,
    quality: QualitySettings,
    times: StageTimes,
    progress: Callable[[int, int], None] | None = None,
    images: ImageSink | None = None,
) -> MatchedSweep:
    """Match every frame of a sweep with the earlier ones that the schedule wants.

    Parameters
    ----------
    times : StageTimes
        To which the time spent is added.
    progress : callable, optional
        Called with frames done and frames in all.
    images : callable, optional
        Called with every intensity image.
    """
    features: list[FrameFeatures] = []
    maker, matched = (
        FrameMaker(sweep.signal, matcher, quality, times),
        FrameByFrame(matcher, trajectory, times),
    )

    def make(index: int) -> MadeReady:
        with times.of("reading"):
            frame = read_frame(sweep.frames, index)
        return maker.make(index, frame)

    def pairs() -> Iterator[tuple[int, int, MatchedPair]]:
        for made in ahead(make, range(len(sweep)), AHEAD):
            if images:
                images(made.number, made.intensity)
            features.append(made.features)
            found = matched.advance(made.number, made.ready)
            yield from ((first, made.number, found[first]) for first in sorted(found))
            if progress:
                progress(made.number + 1, len(sweep))

    return MatchedSweep(CorrelationTable.of(pairs(), len(matcher.patches)), features)


@dataclass(frozen=True)
class MadeReady:
    """What is made of a frame on the way to matching it."""

    number: int
    intensity: Float32Array
    ready: ReadyFrame
    features: FrameFeatures


class FrameByFrame:
    """Matches frames in order; keeps those that later ones are still to be matched with.

    Parameters
    ----------
    matcher : FrameMatcher
    trajectory : TrajectorySettings
    times : StageTimes, optional
        To which the time spent is added.
    """

    def __init__(
        self, matcher: FrameMatcher, trajectory: TrajectorySettings, times: StageTimes | None = None
    ) -> None:
        self._matcher, self._settings, self._times = matcher, trajectory, times or StageTimes()
        self._schedule = PairSchedule(trajectory)
        self._ready: dict[int, ReadyFrame] = {}
        self._motion: dict[int, InPlaneMotion] = {0: InPlaneMotion()}

    def advance(self, frame: int, ready: ReadyFrame) -> dict[int, MatchedPair]:
        """Match a frame with the earlier ones that the schedule wants, latest first.

        Parameters
        ----------
        frame : int
            The number after that of the frame before.
        """
        with self._times.of(MATCHING):
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
            found = self._matcher.search(self._ready[anchor], self._ready[frame])
            self._motion[frame] = compose(self._motion[anchor], found)
            pairs = self._match(references, frame)
            if max(pair.median for pair in pairs.values()) >= self._settings.least_correlation:
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
            found = self._matcher.match_with_each(fixed, self._ready[frame], starts)
            pairs.update({first: MatchedPair.of(match) for first, match in zip(some, found, strict=True)})
            if some[-1] == before and pairs[before].median >= self._settings.least_correlation:
                self._motion[frame] = compose(self._motion[before], pairs[before].motion)
        return pairs


class FrameMaker:
    """Makes frames of one sweep ready to be matched, each by itself and on any thread."""

    def __init__(
        self,
        signal: RFSettings | BModeSettings,
        matcher: FrameMatcher,
        quality: QualitySettings,
        times: StageTimes | None = None,
    ) -> None:
        self._matcher, self._times = matcher, times or StageTimes()
        self._inspector = FrameInspector(signal, matcher.patches, quality)

    def make(self, number: int, frame: npt.NDArray[Any]) -> MadeReady:
        """Make one frame ready; `frame` as read, shape (vector, sample)."""
        with self._times.of("intensity"):
            echo = self._matcher.echo(frame)
            features = self._inspector.inspect(frame, echo.intensity)
            return MadeReady(number, echo.intensity, self._matcher.prepare(echo), features)
