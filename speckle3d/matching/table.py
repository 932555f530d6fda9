"""Pair correlations: what two frames have in common, and all of a sweep's pairs as one table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from speckle3d.matching.inplane import InPlaneMotion, MatchedPair


@dataclass(frozen=True)
class CorrelationTable:
    """The correlations of a sweep's frame pairs: all that later stages need of the images.

    A pair takes about a kilobyte, a frame a megabyte.

    Attributes
    ----------
    first, second : ndarray, shape (e,)
        Frames of each pair.
    correlation : ndarray, shape (e, p)
        Of each patch.
    median : ndarray, shape (e,)
        Median correlation of each pair.
    motion : tuple of InPlaneMotion, length e
    """

    first: IntArray
    second: IntArray
    correlation: Float32Array
    median: FloatArray
    motion: tuple[InPlaneMotion, ...]

    @classmethod
    def of(cls, pairs: Iterable[tuple[int, int, MatchedPair]], patches: int) -> CorrelationTable:
        """Gather pairs, each given as first frame, second frame and what they have in common."""
        # Rounded at once to what is kept, so that memory holds no more than the table.
        rows = [(i, j, p.correlation.astype(np.float32), p.median, p.motion) for i, j, p in pairs]
        frames = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2)
        return cls(
            frames[:, 0],
            frames[:, 1],
            np.array([row[2] for row in rows], dtype=np.float32).reshape(-1, patches),
            np.array([row[3] for row in rows], dtype=float),
            tuple(row[4] for row in rows),
        )

    def __len__(self) -> int:
        return int(self.first.size)

    def among(self, usable: BoolArray) -> CorrelationTable:
        """The same pairs without the correlations of some patches."""
        if usable.all() or not len(self):
            return self
        correlation = np.where(usable, self.correlation, np.float32(np.nan))
        known = np.sort(correlation, axis=1)
        count = np.isfinite(known).sum(axis=1)
        pair, half = np.arange(len(self)), np.maximum(count - 1, 0)
        median = (known[pair, half // 2] + known[pair, np.minimum((half + 1) // 2, half)]) / 2.0
        return replace(self, correlation=correlation, median=np.where(count > 0, median, 0.0).astype(float))

    def where(self, kept: BoolArray, shift: int = 0) -> CorrelationTable:
        """Some of the pairs, their frames numbered `shift` higher."""
        rows = np.flatnonzero(kept)
        return CorrelationTable(
            self.first[rows] + shift,
            self.second[rows] + shift,
            self.correlation[rows],
            self.median[rows],
            tuple(self.motion[row] for row in rows.tolist()),
        )

    @classmethod
    def joined(cls, tables: Sequence[CorrelationTable]) -> CorrelationTable:
        """All pairs of several tables, one at least, in their order."""
        return cls(
            np.concatenate([each.first for each in tables]),
            np.concatenate([each.second for each in tables]),
            np.concatenate([each.correlation for each in tables]),
            np.concatenate([each.median for each in tables]),
            tuple(motion for each in tables for motion in each.motion),
        )

    @cached_property
    def inplane(self) -> FloatArray:
        """In-plane motion (x, y, roll) of each pair's second frame, mm and rad, shape (e, 3)."""
        return np.array([(m.x_mm, m.y_mm, m.roll_rad) for m in self.motion], dtype=float).reshape(-1, 3)

    @cached_property
    def inplane_covariance(self) -> FloatArray:
        """Covariance of `inplane`, shape (e, 3, 3); the identity where it is not known."""
        known = [m.covariance if m.covariance is not None else np.eye(3) for m in self.motion]
        return np.array(known, dtype=float).reshape(-1, 3, 3)

    def unmatched(self, frames: int, least_correlation: float) -> BoolArray:
        """Frames after the first that resemble none of those they were matched with, shape (frames,)."""
        best = np.full(frames, -np.inf)
        np.maximum.at(best, self.second, self.median)
        best[0] = np.inf
        return best < least_correlation
