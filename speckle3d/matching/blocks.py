"""Frames of a sweep matched with earlier ones, in blocks that need nothing of each other.

What two frames have in common does not depend on where other frames lie. A long sweep is therefore matched
in blocks of frames, each a function of the sweep, the configuration and the block alone: here one after
another, or anywhere else in any order, with the same result to the last bit. What is left, planes, signs and
trajectory, is sequential and needs no images.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import Float32Array, FloatArray
from speckle3d.core.sweep import Sweep
from speckle3d.matching.inplane import InPlaneMotion, PatchMatch
from speckle3d.matching.matcher import FrameMatcher, ReadyFrame, compose, inverse
from speckle3d.matching.quality import FrameFeatures, FrameInspector
from speckle3d.matching.schedule import PairSchedule

SEARCHED = 3
"""References against which the in-plane motion of a frame is searched, if it resembles none before."""
AHEAD = 3
"""Frames made ready before they are asked for."""
ImageSink = Callable[[int, Float32Array], None]
"""Called with each frame's number and intensity image (vector, sample), in order, off the main thread."""


_READS_AHEAD: ContextVar[bool] = ContextVar("reads_ahead", default=True)


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Do not read ahead on a second thread: for a cluster's workers, who are given a core each."""
    token = _READS_AHEAD.set(False)
    try:
        yield
    finally:
        _READS_AHEAD.reset(token)


@dataclass
class StageTimes:
    """Seconds spent in each stage; reading and intensity overlap with the rest on another core."""

    seconds: dict[str, float] = field(default_factory=dict)

    def add(self, stage: str, since: float) -> float:
        """Book the time since `since` on `stage`; returns now."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - since
        return now

    def include(self, seconds: Mapping[str, float]) -> None:
        """Add what was spent elsewhere."""
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent


@dataclass(frozen=True)
class Block:
    """Frames from `first` up to, without, `stop`."""

    first: int
    stop: int


@dataclass(frozen=True)
class MatchedPair:
    """What a frame has in common with an earlier one.

    Attributes
    ----------
    correlation : ndarray, shape (p,)
        Of each patch; see `PatchMatch`.
    median : float
        Over the patches that have any; zero if none has.
    """

    correlation: FloatArray
    median: float
    motion: InPlaneMotion

    @classmethod
    def of(cls, match: PatchMatch) -> MatchedPair:
        """Keep what later stages need."""
        return cls(match.correlation, median_correlation(match.correlation), match.motion)


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


def blocks_of(frames: int, block_frames: int) -> list[Block]:
    """Blocks of a sweep: as few as have at most `block_frames` each, and nearly equal."""
    count = -(-frames // block_frames)
    bounds = [frames * k // count for k in range(count + 1)]
    return [Block(first, stop) for first, stop in pairwise(bounds)]


def match_block(
    sweep: Sweep,
    matcher: FrameMatcher,
    config: Config,
    block: Block,
    images: ImageSink | None = None,
    times: StageTimes | None = None,
) -> Iterator[MatchedFrame]:
    """Match each frame of a block with the earlier ones that the schedule wants, those before it included."""
    return _BlockMatcher(sweep, matcher, config, times or StageTimes()).run(block, images)


def median_correlation(correlation: FloatArray) -> float:
    """Median over the patches that have any; zero if none has."""
    known = correlation[np.isfinite(correlation)]
    return float(np.median(known)) if known.size else 0.0


class _BlockMatcher:
    """Frames in, pairs out; keeps the few frames that are still to be matched with."""

    def __init__(self, sweep: Sweep, matcher: FrameMatcher, config: Config, times: StageTimes) -> None:
        self._sweep, self._matcher, self._times = sweep, matcher, times
        self._settings = config.trajectory
        self._inspector = FrameInspector(sweep.signal, matcher.patches, config.quality)
        self._schedule = PairSchedule(config.trajectory)
        self._ready: dict[int, ReadyFrame] = {}
        self._motion: dict[int, InPlaneMotion] = {}

    def run(self, block: Block, images: ImageSink | None) -> Iterator[MatchedFrame]:
        if block.first:
            self._lead_in(block.first)
        else:
            self._motion[0] = InPlaneMotion()
        for frame, ready, features in self._prefetch(range(block.first, block.stop), block.first, images):
            assert features is not None
            yield MatchedFrame(frame, features, self._advance(frame, ready))

    def _advance(self, frame: int, ready: ReadyFrame) -> dict[int, MatchedPair]:
        """Match a frame with its references, and let go of what is no longer needed."""
        then = time.perf_counter()
        self._ready[frame] = ready
        pairs = self._pairs(frame)
        self._schedule.settle(frame, {first: pair.median for first, pair in pairs.items()})
        keep = self._schedule.needed(frame)
        self._ready = {k: v for k, v in self._ready.items() if k in keep}
        self._motion = {k: v for k, v in self._motion.items() if k in keep}
        self._times.add("in-plane motion and correlation", then)
        return pairs

    def _pairs(self, frame: int) -> dict[int, MatchedPair]:
        """Match a frame with its references, from a start found against the first that it resembles."""
        references = self._schedule.references(frame)
        pairs: dict[int, MatchedPair] = {}
        for anchor in references[:SEARCHED]:
            found = self._matcher.search(self._ready[anchor], self._ready[frame])
            self._motion[frame] = compose(self._motion[anchor], found)
            pairs = {first: self._match(first, frame) for first in references}
            if max(pair.median for pair in pairs.values()) >= self._settings.least_correlation:
                break
        else:
            if references:
                self._motion[frame] = self._motion[frame - 1]
        return pairs

    def _match(self, first: int, second: int) -> MatchedPair:
        fixed, moving = self._ready[first], self._ready[second]
        start = compose(inverse(self._motion[first]), self._motion[second])
        pair = MatchedPair.of(self._matcher.match(fixed, moving, start))
        if second - first == 1 and pair.median >= self._settings.least_correlation:
            self._motion[second] = compose(self._motion[first], pair.motion)
        return pair

    def _lead_in(self, first: int) -> None:
        """Find the key frames before a block, going back from it no farther than a block is long.

        By travel and not by a number of frames: after a pause at the border, only frames from before the
        pause tell on which side the next ones are.
        """
        s = self._settings
        most = s.key_frames + s.far_key_frames
        recent, keys, sound = range(max(0, first - s.recent), first), [first - 1], None
        self._motion[first - 1] = InPlaneMotion()
        back = range(first - 1, max(-1, first - 1 - max(s.block_frames, s.recent)), -1)
        with closing(self._prefetch(back, first - 1)) as earlier:
            for frame, ready, _ in earlier:
                then = time.perf_counter()
                self._ready[frame] = ready
                if frame < first - 1:
                    median = self._lead(keys[-1], frame)
                    if sound is None and median >= s.least_correlation:
                        sound = keys[-1]
                    if median < s.key_correlation:
                        keys.append(frame)
                self._ready = {k: v for k, v in self._ready.items() if k in keys or k in recent}
                self._times.add("in-plane motion and correlation", then)
                if len(keys) >= most and frame <= recent.start:
                    break
        self._schedule.begin(sorted(keys[:most]), first - 1 if sound is None else sound)

    def _lead(self, key: int, frame: int) -> float:
        """Match a frame with a key frame after it; its motion is the key frame's if they are not alike."""
        fixed, moving = self._ready[key], self._ready[frame]
        found = self._matcher.match(fixed, moving, self._matcher.search(fixed, moving))
        median = median_correlation(found.correlation)
        alike = median >= self._settings.least_correlation
        self._motion[frame] = compose(self._motion[key], found.motion) if alike else self._motion[key]
        return median

    def _prefetch(
        self, numbers: range, inspected_from: int, images: ImageSink | None = None
    ) -> Generator[tuple[int, ReadyFrame, FrameFeatures | None]]:
        """Frames made ready, a few ahead of use, on a thread of their own; features from some frame on.

        The frame just before a block is inspected, too: whether the first is the same is among its features.
        """

        def make(index: int) -> tuple[int, ReadyFrame, FrameFeatures | None]:
            then = time.perf_counter()
            frame = self._sweep.frames[index]
            then = self._times.add("reading", then)
            echo, features = self._matcher.echo(frame), None
            if index >= inspected_from:
                features = self._inspector.inspect(frame, echo.intensity)
            if images:
                images(index, echo.intensity)
            ready = self._matcher.prepare(echo)
            self._times.add("intensity", then)
            return index, ready, features

        if not _READS_AHEAD.get():
            yield from map(make, numbers)
            return
        with ThreadPoolExecutor(1) as worker:
            waiting: list[Future[tuple[int, ReadyFrame, FrameFeatures | None]]] = []
            try:
                for index in numbers:
                    waiting.append(worker.submit(make, index))
                    if len(waiting) > AHEAD:
                        yield waiting.pop(0).result()
                for future in waiting:
                    yield future.result()
            finally:
                worker.shutdown(wait=True, cancel_futures=True)
