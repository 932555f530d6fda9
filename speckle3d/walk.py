"""First reading of a sweep: frames in, the correlations of its frame pairs and a rough path out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from speckle3d.config import Config
from speckle3d.core.geometry import FloatArray
from speckle3d.core.sweep import Sweep
from speckle3d.motion.distances import DistanceEstimator
from speckle3d.motion.inplane import InPlaneMotion, PatchMatch
from speckle3d.motion.intensity import Float32Array
from speckle3d.motion.matching import FrameMatcher, ReadyFrame, compose, inverse
from speckle3d.motion.planes import PlaneFitter
from speckle3d.motion.quality import FrameFeatures, FrameInspector
from speckle3d.motion.schedule import PairSchedule
from speckle3d.motion.signs import SignResolver
from speckle3d.motion.table import CorrelationTable

SEARCHED = 3
"""References against which the in-plane motion of a frame is searched, if it resembles none before."""
ImageSink = Callable[[int, Float32Array], None]
"""Called with each frame's number and intensity image (vector, sample), in order, off the main thread."""


@dataclass
class StageTimes:
    """Seconds spent in each stage; reading and intensity overlap with the rest on another core."""

    seconds: dict[str, float] = field(default_factory=dict)

    def add(self, stage: str, since: float) -> float:
        """Book the time since `since` on `stage`; returns now."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - since
        return now


class Walk:
    """First reading of the sweep: which pairs to match, what they share, where frames roughly lie."""

    def __init__(
        self, sweep: Sweep, matcher: FrameMatcher, estimator: DistanceEstimator, config: Config
    ) -> None:
        self.sweep, self.matcher, self.estimator, self.config = sweep, matcher, estimator, config
        self.times = StageTimes()
        self.table = CorrelationTable(len(matcher.patches))
        self.fitter = PlaneFitter(estimator, matcher.at_mm, config.planes)
        self.unmatched: list[int] = []
        self.features: list[FrameFeatures] = []
        self._schedule = PairSchedule(config.trajectory)
        self._signs = SignResolver(len(sweep))
        self._ready: dict[int, ReadyFrame] = {}
        self._motion: dict[int, InPlaneMotion] = {0: InPlaneMotion()}

    @property
    def path(self) -> FloatArray:
        """Rough elevational position of each frame's centre and its slope along x, shape (n, 2)."""
        return self._signs.path

    def advance(self, frame: int, ready: ReadyFrame) -> None:
        """Match a frame with its references, place it, and let go of what is no longer needed."""
        self._ready[frame] = ready
        matches, correlations = self._matches(frame)
        if frame:
            self._place(frame, matches, correlations)
        self._schedule.settle(frame, correlations)
        keep = self._schedule.needed(frame)
        self._ready = {k: v for k, v in self._ready.items() if k in keep}
        self._motion = {k: v for k, v in self._motion.items() if k in keep}

    def _matches(self, frame: int) -> tuple[dict[int, PatchMatch], dict[int, float]]:
        """Match a frame with its references, from a start found against the first that it resembles."""
        then = time.perf_counter()
        references = self._schedule.references(frame)
        matches: dict[int, PatchMatch] = {}
        correlations: dict[int, float] = {}
        for anchor in references[:SEARCHED]:
            found = self.matcher.search(self._ready[anchor], self._ready[frame])
            self._motion[frame] = compose(self._motion[anchor], found)
            matches = {first: self._match(first, frame) for first in references}
            correlations = {first: median_correlation(match.correlation) for first, match in matches.items()}
            if max(correlations.values()) >= self.config.trajectory.least_correlation:
                break
        else:
            if references:
                self._motion[frame] = self._motion[frame - 1]
        self.times.add("in-plane motion and correlation", then)
        return matches, correlations

    def _match(self, first: int, second: int) -> PatchMatch:
        fixed, moving = self._ready[first], self._ready[second]
        start = compose(inverse(self._motion[first]), self._motion[second])
        match = self.matcher.match(fixed, moving, start)
        if (
            second - first == 1
            and median_correlation(match.correlation) >= self.config.trajectory.least_correlation
        ):
            self._motion[second] = compose(self._motion[first], match.motion)
        return match

    def _place(self, frame: int, matches: dict[int, PatchMatch], correlations: dict[int, float]) -> None:
        then = time.perf_counter()
        least = self.config.trajectory.least_correlation
        near = [first for first, rho in correlations.items() if rho >= least]
        if not near:
            near = [max(correlations, key=lambda first: correlations[first])]
            self.unmatched.append(frame)
        planes = {}
        for first in near:
            motion = matches[first].motion
            plane = self.fitter.fit(matches[first].correlation, np.array([motion.x_mm, motion.y_mm]))
            if plane is not None:
                planes[first] = plane
        if planes:
            self._signs.place(frame, list(planes), list(planes.values()))
        else:
            self._signs.hold(frame)
        for first, match in sorted(matches.items()):
            self.table.append(first, frame, match)
        self.times.add("distances and planes", then)


def prefetch(walk: Walk, images: ImageSink | None, ahead: int = 3) -> Iterator[ReadyFrame]:
    """Frames made ready, a few ahead of use, on a thread of their own; their features go to the walk."""
    sweep, matcher, times = walk.sweep, walk.matcher, walk.times
    inspector = FrameInspector(sweep.signal, matcher.patches, walk.config.quality)

    def make(index: int) -> ReadyFrame:
        then = time.perf_counter()
        frame = sweep.frames[index]
        then = times.add("reading", then)
        echo = matcher.echo(frame)
        walk.features.append(inspector.inspect(frame, echo.intensity))
        if images:
            images(index, echo.intensity)
        ready = matcher.prepare(echo)
        times.add("intensity", then)
        return ready

    with ThreadPoolExecutor(1) as worker:
        waiting: list[Future[ReadyFrame]] = []
        try:
            for index in range(len(sweep)):
                waiting.append(worker.submit(make, index))
                if len(waiting) > ahead:
                    yield waiting.pop(0).result()
            for future in waiting:
                yield future.result()
        finally:
            worker.shutdown(wait=True, cancel_futures=True)


def median_correlation(correlation: FloatArray) -> float:
    """Median over the patches that have any; zero if none has."""
    known = correlation[np.isfinite(correlation)]
    return float(np.median(known)) if known.size else 0.0
