"""First reading of a sweep's correlations: frames placed one after the other, on a rough path."""

from __future__ import annotations

import time

import numpy as np

from speckle3d.config import Config
from speckle3d.core.arrays import FloatArray
from speckle3d.core.sweep import Sweep
from speckle3d.matching.blocks import MatchedFrame, MatchedPair, StageTimes
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.quality import FrameFeatures
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.distances import DistanceEstimator
from speckle3d.motion.planes import PlaneFitter
from speckle3d.motion.signs import SignResolver


class Walk:
    """First reading of the sweep: what its pairs share, and where frames roughly lie."""

    def __init__(
        self, sweep: Sweep, matcher: FrameMatcher, estimator: DistanceEstimator, config: Config
    ) -> None:
        self.sweep, self.matcher, self.estimator, self.config = sweep, matcher, estimator, config
        self.times = StageTimes()
        self.table = CorrelationTable(len(matcher.patches))
        self.fitter = PlaneFitter(estimator, matcher.at_mm, config.planes)
        self.unmatched: list[int] = []
        self.features: list[FrameFeatures] = []
        self._signs = SignResolver(len(sweep))

    @property
    def path(self) -> FloatArray:
        """Rough elevational position of each frame's centre and its slope along x, shape (n, 2)."""
        return self._signs.path

    def place(self, matched: MatchedFrame) -> None:
        """Place the next frame by its pairs, and keep them for the second reading."""
        self.features.append(matched.features)
        if not matched.frame:
            return
        then = time.perf_counter()
        near = self._near(matched)
        planes = {}
        for first in near:
            pair = matched.pairs[first]
            plane = self.fitter.fit(pair.correlation, np.array([pair.motion.x_mm, pair.motion.y_mm]))
            if plane is not None:
                planes[first] = plane
        if planes:
            self._signs.place(matched.frame, list(planes), list(planes.values()))
        else:
            self._signs.hold(matched.frame)
        for first, pair in sorted(matched.pairs.items(), key=_first):
            self.table.append(first, matched.frame, pair)
        self.times.add("distances and planes", then)

    def _near(self, matched: MatchedFrame) -> list[int]:
        """Earlier frames that a frame resembles; else the likest one, and the frame is noted."""
        least = self.config.trajectory.least_correlation
        near = [first for first, pair in matched.pairs.items() if pair.median >= least]
        if not near:
            self.unmatched.append(matched.frame)
            near = [max(matched.pairs, key=lambda first: matched.pairs[first].median)]
        return near


def _first(item: tuple[int, MatchedPair]) -> int:
    return item[0]
