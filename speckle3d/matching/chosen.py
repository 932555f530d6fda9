"""Chosen frame pairs: those of a phantom at known distances, and of a sweep that comes back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache

from speckle3d.core.arrays import IntArray
from speckle3d.core.sweep import Sweep
from speckle3d.matching.inplane import InPlaneMotion, PatchMatch
from speckle3d.matching.matcher import FrameMatcher, ReadyFrame, compose, inverse
from speckle3d.matching.table import CorrelationTable, MatchedPair

KEPT_FRAMES = 24
"""Frames kept ready while returns are matched: one, and all that it is matched with."""


def match_in_order(
    sweep: Sweep, matcher: FrameMatcher, pairs: IntArray, progress: Callable[[int, int], None] | None = None
) -> Iterator[tuple[int, int, PatchMatch]]:
    """Match pairs of a sweep, in-plane motion being followed from frame to frame.

    Each frame is read once, in order, and kept while later ones are still to be matched with it.

    Parameters
    ----------
    pairs : ndarray, shape (m, 2)
        First and second frame of each.
    """
    kept: dict[int, ReadyFrame] = {}
    motion = {0: InPlaneMotion()}
    for frame in range(len(sweep)):
        kept[frame] = matcher.prepare(matcher.echo(sweep.frames[frame]))
        if frame:
            start = matcher.search(kept[frame - 1], kept[frame])
            step = matcher.match(kept[frame - 1], kept[frame], start).motion
            motion[frame] = compose(motion[frame - 1], step)
        for first in pairs[pairs[:, 1] == frame, 0].tolist():
            start = compose(inverse(motion[first]), motion[frame])
            yield first, frame, matcher.match(kept[first], kept[frame], start)
        needed = pairs[pairs[:, 1] > frame, 0]
        kept = {k: v for k, v in kept.items() if k == frame or k in needed}
        if progress:
            progress(frame + 1, len(sweep))


def match_again(sweep: Sweep, matcher: FrameMatcher, pairs: Iterable[tuple[int, int]]) -> CorrelationTable:
    """Match any pairs of a sweep, reading frames anew; in-plane motion is searched for in each pair."""

    @lru_cache(KEPT_FRAMES)
    def ready(frame: int) -> ReadyFrame:
        return matcher.prepare(matcher.echo(sweep.frames[frame]))

    def matched(first: int, second: int) -> MatchedPair:
        fixed, moving = ready(first), ready(second)
        return MatchedPair.of(matcher.match(fixed, moving, matcher.search(fixed, moving)))

    return CorrelationTable.of(((i, j, matched(i, j)) for i, j in pairs), len(matcher.patches))
