"""Chosen frame pairs: those of a phantom at known distances, and of a sweep that comes back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from operator import itemgetter

from speckle3d.core.arrays import IntArray
from speckle3d.core.sweep import Sweep, read_frame
from speckle3d.core.threads import ahead
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
    """Match any pairs of a sweep, reading frames anew; in-plane motion is searched for in each pair.

    Fastest where pairs of one second frame follow each other.
    """
    kept: dict[int, ReadyFrame] = {}

    def matched() -> Iterator[tuple[int, int, MatchedPair]]:
        for second, some in groupby(pairs, key=itemgetter(1)):
            earlier = [first for first, _ in some]
            _keep_ready(kept, [*earlier, second], sweep, matcher)
            fixed, moving = [kept[first] for first in earlier], kept[second]
            starts = _searched(fixed, moving, matcher)
            found = matcher.match_with_each(fixed, moving, starts)
            yield from ((i, second, MatchedPair.of(match)) for i, match in zip(earlier, found, strict=True))

    return CorrelationTable.of(matched(), len(matcher.patches))


def _keep_ready(
    kept: dict[int, ReadyFrame], wanted: Sequence[int], sweep: Sweep, matcher: FrameMatcher
) -> None:
    """Have some frames ready, and of others those that were last asked for."""
    missing = sorted(set(wanted) - kept.keys())
    made = ahead(lambda frame: matcher.prepare(matcher.echo(read_frame(sweep.frames, frame))), missing)
    kept |= dict(zip(missing, made, strict=True))
    for frame in wanted:
        kept[frame] = kept.pop(frame)
    for frame in list(kept)[: max(0, len(kept) - max(KEPT_FRAMES, len(wanted)))]:
        del kept[frame]


def _searched(fixed: Sequence[ReadyFrame], moving: ReadyFrame, matcher: FrameMatcher) -> list[InPlaneMotion]:
    """In-plane motion of a frame against each of some others, to the nearest sample."""
    return list(ahead(lambda other: matcher.search(other, moving), fixed))
