"""What is learnt of a sweep that grows, and its poses by it: all of it, or its latest frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, starmap

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import BoolArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.live.window import FramePlanes, Known, Window
from speckle3d.matching.blocks import StageTimes
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.quality import FrameFlag
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.estimate import PairReader
from speckle3d.motion.signs import SignedPairs
from speckle3d.stages import measured, sound_pairs

LATEST = 150
"""Frames over which coherence is learnt anew while a sweep is longer: five times `CoherenceSettings`' block.
A third of them stay where they are, so that coherence is seen on both sides of those that are placed."""
STAYING = 50


@dataclass(frozen=True)
class Growing:
    """A sweep as far as it has been matched, for another thread: nothing in it changes.

    Attributes
    ----------
    tables : sequence of CorrelationTable
        Pairs of each frame.
    flags : ndarray of int, shape (n,)
    poses : RigidTransform, length n
        As they are known now.
    """

    tables: Sequence[CorrelationTable]
    flags: IntArray
    poses: RigidTransform

    def __len__(self) -> int:
        return len(self.tables)


@dataclass(frozen=True)
class Revision:
    """Poses of frames `first` to `stop`, by what is now known.

    Attributes
    ----------
    poses : RigidTransform, length stop - first
    planes : sequence of FramePlanes
        Of each of these frames.
    known : Known
    whole : bool
        Whether all of the sweep was looked at.
    """

    first: int
    stop: int
    poses: RigidTransform
    planes: Sequence[FramePlanes]
    known: Known
    whole: bool


class Reviser:
    """Estimates anew what is known of a sweep; keeps nothing of it.

    Parameters
    ----------
    matcher : FrameMatcher
    curves : DecorrelationCurves
    config : Config

    Attributes
    ----------
    reader : PairReader
        With the curves as given.
    """

    def __init__(self, matcher: FrameMatcher, curves: DecorrelationCurves, config: Config) -> None:
        self._config = config
        self.reader = PairReader(
            curves, matcher.patches, matcher.centre_mm, 1, config.planes, config.trajectory
        )

    def whole(self, sweep: Growing) -> Revision:
        """Estimate everything from all frames, as `track` does of a recording, but for returns.

        Raises
        ------
        InsufficientDataError
            If the images do not determine a plane yet.
        """
        table, config = CorrelationTable.joined(sweep.tables), self._config
        reader, times = self.reader.of_frames(len(sweep)), StageTimes()
        _require_any(sound_pairs(table, sweep.flags))
        pairs, coherence, *_ = measured(table, sweep.flags, reader, config, times)
        slopes = reader.slopes(pairs, coherence)
        poses = reader.solve(reader.edges(table, pairs, slopes.applied(pairs.planes))).poses
        held = _by_frame(pairs, 0, [len(each) for each in sweep.tables])
        return Revision(0, len(sweep), poses, held, Known(reader, coherence, slopes), True)

    def latest(self, sweep: Growing, known: Known) -> Revision:
        """Learn coherence anew from the latest frames, and place those of them that it tells about.

        Raises
        ------
        InsufficientDataError
            If their images do not determine a plane.
        """
        begin = max(1, len(sweep) - LATEST)
        first = begin + STAYING
        bad = (sweep.flags & ~int(FrameFlag.UNMATCHED)) != 0
        window = Window.of(sweep.tables, first, sweep.poses, bad, known.reader, begin)
        _require_any(window.sound)
        reader, coherence = known.reader.of_frames(window.frames.size), known.coherence
        path = window.path
        if coherence is not None:
            coherence, scale, _ = reader.coherence(window.table, path, window.sound)
            path = path * scale
        pairs = reader.unsigned(window.table, path, window.sound, coherence)
        pairs, _ = reader.signed(window.table, pairs, window.sound, window.path[: window.fixed])
        poses = window.placed(pairs, known.slopes, reader)[window.fixed :]
        there = None if coherence is None else window.coherence_there(coherence)
        skipped = sum(len(each) for each in sweep.tables[begin:first])
        counts = [len(each) for each in sweep.tables[first:]]
        held = _by_frame(pairs, window.fixed, counts, skipped, window.frames)
        return Revision(first, len(sweep), poses, held, Known(known.reader, there, known.slopes), False)


def _require_any(sound: BoolArray) -> None:
    if not sound.any():
        raise InsufficientDataError("expected pairs of frames to be trusted, got none")


def _by_frame(
    pairs: SignedPairs, first: int, counts: Sequence[int], skipped: int = 0, frames: IntArray | None = None
) -> list[FramePlanes]:
    """Planes of the pairs of each frame from `first` on.

    Parameters
    ----------
    counts : sequence of int
        Rows in each of these frames' tables; `skipped` rows come before them.
    frames : ndarray of int, optional
        Numbers in the sweep of those in `pairs`.
    """
    begin = skipped + np.concatenate([[0], np.cumsum(counts)])
    bounds = np.searchsorted(pairs.second, np.arange(first, first + len(counts) + 1))
    there = pairs.first if frames is None else frames[pairs.first]
    return [
        FramePlanes(pairs.row[some] - before, there[some], pairs.planes[some])
        for before, some in zip(begin[:-1], starmap(slice, pairwise(bounds)), strict=True)
    ]
