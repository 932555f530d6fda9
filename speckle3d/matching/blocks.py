"""Frames of a sweep matched with earlier ones, in blocks that can be matched independently of each other.

What two frames have in common does not depend on where other frames lie, so that a long sweep is matched in
blocks: each is a function of the sweep, the settings and the block's frame numbers alone. Blocks may run one
after another or in any order, in any process, with the same result to the last bit.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
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

    def include(self, seconds: Mapping[str, float]) -> None:
        """Add what was spent elsewhere."""
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent


@dataclass(frozen=True)
class Block:
    """Frames `first` to `stop`, `stop` excluded."""

    first: int
    stop: int


@dataclass(frozen=True)
class MatchedFrame:
    """A frame's features and its pairs, by the earlier frame, latest first."""

    frame: int
    features: FrameFeatures
    pairs: Mapping[int, MatchedPair]


@dataclass(frozen=True)
class MatchedBlock:
    """A block's frames in order, and the seconds spent in each stage."""

    frames: Sequence[MatchedFrame]
    seconds: Mapping[str, float]


BlockSource = Callable[[Block], MatchedBlock | None]
"""Returns a block that has been matched already, None for one that has not."""


@dataclass(frozen=True)
class MatchedSweep:
    """All pairs of a sweep, sorted by second frame, then by first, and the features of every frame."""

    table: CorrelationTable
    features: Sequence[FrameFeatures]


def blocks_of(frames: int, block_frames: int) -> list[Block]:
    """Split a sweep into the fewest near-equal blocks of at most `block_frames`."""
    count = -(-frames // block_frames)
    bounds = [frames * k // count for k in range(count + 1)]
    return [Block(first, stop) for first, stop in pairwise(bounds)]


def match_sweep(
    sweep: Sweep,
    matcher: FrameMatcher,
    trajectory: TrajectorySettings,
    quality: QualitySettings,
    times: StageTimes,
    progress: Callable[[int, int], None] | None = None,
    images: ImageSink | None = None,
    given: BlockSource | None = None,
) -> MatchedSweep:
    """Match every frame of a sweep with the earlier ones that the schedule wants.

    Parameters
    ----------
    times : StageTimes
        To which the time spent is added.
    progress : callable, optional
        Called with frames done and frames in all.
    images : callable, optional
        Called with every intensity image, but not with those of blocks that `given` returns.
    given : callable, optional
        Asked for each block before it is matched here.
    """
    features: list[FrameFeatures] = []

    def pairs() -> Iterator[tuple[int, int, MatchedPair]]:
        for block in blocks_of(len(sweep), trajectory.block_frames):
            held = given(block) if given else None
            if held:
                times.include(held.seconds)
            matched = (
                held.frames
                if held
                else match_block(sweep, matcher, trajectory, quality, block, images, times)
            )
            for each in matched:
                features.append(each.features)
                yield from ((first, each.frame, each.pairs[first]) for first in sorted(each.pairs))
                if progress:
                    progress(each.frame + 1, len(sweep))

    return MatchedSweep(CorrelationTable.of(pairs(), len(matcher.patches)), features)


def match_block(
    sweep: Sweep,
    matcher: FrameMatcher,
    trajectory: TrajectorySettings,
    quality: QualitySettings,
    block: Block,
    images: ImageSink | None = None,
    times: StageTimes | None = None,
) -> Iterator[MatchedFrame]:
    """Match each frame of a block with the earlier ones that the schedule wants, those before it included."""
    return _BlockMatcher(sweep, matcher, trajectory, quality, times or StageTimes()).run(block, images)


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

    def lead_in(self, first: int, back: Iterable[tuple[int, ReadyFrame]]) -> None:
        """Find the key frames before a frame to begin with.

        Key frames are so far apart in travel, not in time: after a pause at the border, only frames from
        before the pause tell on which side the next ones are.

        Parameters
        ----------
        back : iterable of (int, ReadyFrame)
            Frames before `first`, latest first, taken as far as is needed.
        """
        s = self._settings
        most = s.key_frames + s.far_key_frames
        recent, keys, sound = range(max(0, first - s.recent), first), [first - 1], None
        self._motion = {first - 1: InPlaneMotion()}
        for frame, ready in back:
            with self._times.of(MATCHING):
                self._ready[frame] = ready
                if frame < first - 1:
                    median = self._lead(keys[-1], frame)
                    if sound is None and median >= s.least_correlation:
                        sound = keys[-1]
                    if median < s.key_correlation:
                        keys.append(frame)
                self._ready = {k: v for k, v in self._ready.items() if k in keys or k in recent}
            if len(keys) >= most and frame <= recent.start:
                break
        self._schedule.begin(sorted(keys[:most]), first - 1 if sound is None else sound)

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

    def _lead(self, key: int, frame: int) -> float:
        """Match a frame with a key frame after it; its motion is the key frame's if they are not alike."""
        fixed, moving = self._ready[key], self._ready[frame]
        found = self._matcher.match(fixed, moving, self._matcher.search(fixed, moving))
        median = MatchedPair.of(found).median
        alike = median >= self._settings.least_correlation
        self._motion[frame] = compose(self._motion[key], found.motion) if alike else self._motion[key]
        return median


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


class _BlockMatcher:
    """Matches the frames of a block."""

    def __init__(
        self,
        sweep: Sweep,
        matcher: FrameMatcher,
        trajectory: TrajectorySettings,
        quality: QualitySettings,
        times: StageTimes,
    ) -> None:
        self._sweep, self._settings, self._times = sweep, trajectory, times
        self._maker = FrameMaker(sweep.signal, matcher, quality, times)
        self._matched = FrameByFrame(matcher, trajectory, times)

    def run(self, block: Block, images: ImageSink | None) -> Iterator[MatchedFrame]:
        if block.first:
            self._lead_in(block.first)
        for made in self._made_ready(range(block.first, block.stop), images):
            yield MatchedFrame(made.number, made.features, self._matched.advance(made.number, made.ready))

    def _lead_in(self, first: int) -> None:
        """Find the key frames before a block, going back from it no farther than a block is long."""
        farthest = max(self._settings.block_frames, self._settings.recent)
        back = range(first - 1, max(-1, first - 1 - farthest), -1)
        with closing(self._made_ready(back)) as earlier:
            self._matched.lead_in(first, ((made.number, made.ready) for made in earlier))

    def _made_ready(self, numbers: range, images: ImageSink | None = None) -> Generator[MadeReady]:
        """Yield frames in order, made ready a few ahead of use; images go to their sink in order, too."""

        def make(index: int) -> MadeReady:
            with self._times.of("reading"):
                frame = read_frame(self._sweep.frames, index)
            return self._maker.make(index, frame)

        for made in ahead(make, numbers, AHEAD):
            if images:
                images(made.number, made.intensity)
            yield made
