"""Frames of a sweep that comes back, matched with those of its way there.

A sweep that returns over the same tissue sees speckle that it has seen before, and the two ways can be tied
together. Frames are read a second time for it, a few at a time.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.matching.blocks import median_correlation
from speckle3d.matching.inplane import PatchMatch
from speckle3d.matching.matcher import ReadyFrame
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.distances import EchoModel
from speckle3d.motion.path import Walk
from speckle3d.motion.planes import PairPlane

AWAY_MM = 3.0
"""Travel between two visits: less is within reach of the pairs measured anyway."""
REACH_MM, REACH_PER_MM = 0.4, 0.02
"""How far off a return may be found: speckle's range, and drift with travel."""
SPACING_MM = 0.15
MOST_CANDIDATES = 16
KEPT_FRAMES = 24
LEAST_PAIRS = 4
CAP, MARGIN = 9.0, 6.0
"""Squared deviations at which a pair counts as wrong, and by which a place must beat any other."""
BEYOND_MM, BEYOND_SIGMA_MM = 0.5, 0.1
"""Frames without common speckle are about this far apart or more."""
RELATIVE_ERROR, FIXED_ERROR_MM = 0.1, 0.02


@dataclass(frozen=True)
class Revisit:
    """A pair of frames from two visits: how its echoes are read, its plane and the plane's sign."""

    first: int
    second: int
    match: PatchMatch
    model: EchoModel | None
    plane: PairPlane
    sign: float


def find_revisits(walk: Walk, position_mm: FloatArray, coherence: Coherence | None) -> list[Revisit]:
    """Match frames of later visits, `revisit_mm` of travel apart, with those of earlier ones.

    Parameters
    ----------
    position_mm : ndarray, shape (n,)
        Elevational position of each frame's centre, right to a few hundredths of the travel.
    """
    every = walk.config.trajectory.revisit_mm
    if every == 0:
        return []
    travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position_mm)))])
    reader = _Reader(walk)
    found: list[Revisit] = []
    last = -np.inf
    for second in range(1, position_mm.size):
        if travel[second] - last < every:
            continue
        earlier = _candidates(second, position_mm, travel)
        if len(earlier) < LEAST_PAIRS:
            continue
        last = travel[second]
        found += _tie(walk, reader, second, earlier, position_mm, travel, coherence)
    return found


def _candidates(second: int, position_mm: FloatArray, travel: FloatArray) -> list[int]:
    """Earlier frames that a frame may have come back to, thinned, nearest first."""
    between = travel[second] - travel[:second]
    off = np.abs(position_mm[:second] - position_mm[second])
    near = np.flatnonzero((between > AWAY_MM) & (off < REACH_MM + REACH_PER_MM * between))
    # The latest visit is tied to those before it already; one of its frames in every bin of position.
    visit = np.cumsum(np.diff(near, prepend=-2) > 1)
    near = near[visit == visit.max(initial=0)]
    _, one = np.unique(np.round(position_mm[near] / SPACING_MM), return_index=True)
    thinned = near[one]
    return [int(i) for i in thinned[np.argsort(off[thinned])][:MOST_CANDIDATES]]


def _tie(
    walk: Walk,
    reader: _Reader,
    second: int,
    earlier: Sequence[int],
    position_mm: FloatArray,
    travel: FloatArray,
    coherence: Coherence | None,
) -> list[Revisit]:
    """Pairs of one frame with those it came back to, if they agree on one place for it."""
    read = {}
    for first in earlier:
        match = reader.match(first, second)
        if median_correlation(match.correlation) >= walk.config.trajectory.least_correlation:
            model = None
            if coherence is not None:
                apart = np.array([position_mm[second] - position_mm[first]])
                model = coherence.models(np.array([float(first)]), apart)[0]
            moved = np.array([match.motion.x_mm, match.motion.y_mm])
            plane = walk.fitter.fit(match.correlation, moved, model)
            if plane is not None:
                read[first] = Revisit(first, second, match, model, plane, 1.0)
    if len(read) < LEAST_PAIRS:
        return []
    reach = REACH_MM + REACH_PER_MM * float(np.ptp(travel[[*earlier, second]]))
    planes = [read[i].plane if i in read else None for i in earlier]
    shift = _place(position_mm[second] - position_mm[list(earlier)], planes, reach)
    if shift is None:
        return []
    at = position_mm[second] + shift
    return [replace(r, sign=1.0 if at >= position_mm[i] else -1.0) for i, r in read.items()]


def _place(apart_mm: FloatArray, planes: Sequence[PairPlane | None], reach_mm: float) -> float | None:
    """Shift of a frame at which all its distances agree; None if no place is clearly the best.

    Parameters
    ----------
    apart_mm : ndarray, shape (c,)
        Signed distance from each candidate as the path has it.
    planes : sequence of PairPlane or None
        None for candidates without common speckle.
    """
    shifts = np.arange(-reach_mm, reach_mm + 0.01, 0.02)
    distance = np.abs(apart_mm[:, None] + shifts)
    cost = np.zeros(shifts.size)
    for row, plane in zip(distance, planes, strict=True):
        if plane is None:
            misfit = np.maximum(BEYOND_MM - row, 0.0) / BEYOND_SIGMA_MM
        else:
            sigma = np.sqrt(
                plane.covariance[0, 0] + (RELATIVE_ERROR * plane.offset_mm) ** 2 + FIXED_ERROR_MM**2
            )
            misfit = (row - plane.offset_mm) / sigma
        cost += np.minimum(misfit**2, CAP)
    best = int(np.argmin(cost))
    others = np.abs(shifts - shifts[best]) > SPACING_MM
    if others.any() and cost[others].min() - cost[best] < MARGIN:
        return None
    return float(shifts[best])


class _Reader:
    """Matches any two frames, keeping the latest read ones ready."""

    def __init__(self, walk: Walk) -> None:
        self._walk = walk
        self._ready: OrderedDict[int, ReadyFrame] = OrderedDict()

    def match(self, first: int, second: int) -> PatchMatch:
        """In-plane motion and correlation, searched for over the whole range."""
        fixed, moving = self._frame(first), self._frame(second)
        matcher = self._walk.matcher
        return matcher.match(fixed, moving, matcher.search(fixed, moving))

    def _frame(self, index: int) -> ReadyFrame:
        if index in self._ready:
            self._ready.move_to_end(index)
            return self._ready[index]
        matcher = self._walk.matcher
        ready = matcher.prepare(matcher.echo(self._walk.sweep.frames[index]))
        self._ready[index] = ready
        if len(self._ready) > KEPT_FRAMES:
            self._ready.popitem(last=False)
        return ready
