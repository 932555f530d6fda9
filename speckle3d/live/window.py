"""Some frames of a growing sweep as a small sweep of their own: those to be placed, and what holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.estimate import PairReader
from speckle3d.motion.planes import PairPlanes
from speckle3d.motion.signs import SignedPairs
from speckle3d.motion.uncertainty import SlopeEvidence

BEFORE = 10
"""Frames just before the first that is placed that are always there: the way they went is remembered."""


@dataclass(frozen=True)
class Known:
    """What has been learnt of a sweep so far, with which further pairs are read.

    Attributes
    ----------
    reader : PairReader
    coherence : Coherence or None
        By the frames of the sweep.
    slopes : SlopeEvidence
    """

    reader: PairReader
    coherence: Coherence | None
    slopes: SlopeEvidence


@dataclass(frozen=True)
class FramePlanes:
    """Planes of one frame's pairs, as they were read last; their signs are open.

    Attributes
    ----------
    row : ndarray of int, shape (e,)
        Of each pair in the frame's table.
    first : ndarray of int, shape (e,)
        Its earlier frame.
    planes : PairPlanes
    """

    row: IntArray
    first: IntArray
    planes: PairPlanes


@dataclass(frozen=True)
class Window:
    """Frames of a growing sweep, numbered anew from zero.

    Attributes
    ----------
    frames : ndarray of int, shape (n,)
        Their numbers in the sweep, rising.
    fixed : int
        So many at the beginning stay where they are.
    table : CorrelationTable
        Pairs of the others with all of these, and of the fixed ones among themselves.
    path : ndarray, shape (n, 2)
        Elevational position of each frame's centre and its slope along x; of the fixed ones as it stays.
    poses : RigidTransform, length n
        ``world_from_image``; of the fixed ones as they stay.
    sound : ndarray of bool, shape (e,)
        Pairs both of whose frames are to be trusted.
    """

    frames: IntArray
    fixed: int
    table: CorrelationTable
    path: FloatArray
    poses: RigidTransform
    sound: BoolArray

    @classmethod
    def of(
        cls,
        tables: Sequence[CorrelationTable],
        first: int,
        poses: RigidTransform,
        bad: BoolArray,
        reader: PairReader,
        begin: int | None = None,
    ) -> Window:
        """Frames from `first` on, which are to be placed, and those that they stand on.

        Parameters
        ----------
        tables : sequence of CorrelationTable
            Pairs of each frame of the sweep.
        poses : RigidTransform, length n
            Of all frames; of those from `first` on about right.
        bad : ndarray of bool, shape (n,)
            Frames that are not to be trusted.
        begin : int, optional
            First of the frames that stay whose pairs among themselves are wanted, too; by default none are.
        """
        begin = first if begin is None else begin
        of = CorrelationTable.joined(tables[begin:])
        stay = np.arange(max(0, min(begin, first - BEFORE)), first)
        stay = np.unique(np.concatenate([stay, of.first[of.first < first]]))
        frames = np.concatenate([stay, np.arange(first, len(tables))])
        table = replace(
            of, first=np.searchsorted(frames, of.first), second=np.searchsorted(frames, of.second)
        )
        sound = ~bad[of.first] & ~bad[of.second]
        return cls(frames, stay.size, table, reader.path_of(poses[frames]), poses[frames], sound)

    def coherence_here(self, coherence: Coherence | None) -> Coherence | None:
        """Give the sweep's coherence by these frames' numbers."""
        if coherence is None:
            return None
        inside = np.interp(coherence.frame, self.frames, np.arange(float(self.frames.size)))
        # Beyond the frames that are here, neighbours go on as far apart as they were.
        beyond = np.maximum(coherence.frame - self.frames[-1], 0) - np.maximum(
            self.frames[0] - coherence.frame, 0
        )
        return replace(coherence, frame=inside + beyond)

    def coherence_there(self, coherence: Coherence) -> Coherence:
        """Give coherence by these frames' numbers by those of the sweep."""
        there = np.interp(coherence.frame, np.arange(float(self.frames.size)), self.frames.astype(float))
        return replace(coherence, frame=there)

    def placed(self, pairs: SignedPairs, slopes: SlopeEvidence, reader: PairReader) -> RigidTransform:
        """Poses of all frames by pairs of those that do not stay."""
        loose = pairs[pairs.second >= self.fixed]
        edges = reader.edges(self.table, loose, slopes.applied(loose.planes))
        return reader.solve_onto(edges, self.poses[: self.fixed])
