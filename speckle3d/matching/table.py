"""Table of patch correlations and in-plane motion of a sweep's frame pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from speckle3d.core.arrays import BoolArray, Float32Array, FloatArray, IntArray


@dataclass(frozen=True)
class CorrelationTable:
    """Patch correlations and in-plane motion of a sweep's frame pairs.

    A pair takes about a kilobyte, a frame a megabyte.

    Attributes
    ----------
    first, second : ndarray, shape (e,)
        Frames of each pair.
    correlation : ndarray, shape (e, p)
        Of each patch; see `speckle3d.kernels.inplane.Matches`.
    inplane : ndarray, shape (e, 3)
        Motion (x, y, roll) of the second frame in the first one's plane, about the centre, mm and rad.
    inplane_covariance : ndarray, shape (e, 3, 3)
        Of `inplane`; the identity where it is not known.
    """

    first: IntArray
    second: IntArray
    correlation: Float32Array
    inplane: FloatArray
    inplane_covariance: FloatArray

    def __len__(self) -> int:
        return int(self.first.size)

    @cached_property
    def median(self) -> FloatArray:
        """Median of each pair's correlations, shape (e,); zero where there is none."""
        values, rows = np.sort(self.correlation.astype(float)), np.arange(len(self))  # NaN last
        last = np.isfinite(values).sum(axis=1) - 1
        return np.asarray(np.nan_to_num(0.5 * (values[rows, last // 2] + values[rows, (last + 1) // 2])))

    def among(self, usable: BoolArray) -> CorrelationTable:
        """Copy of the table without the correlations of some patches."""
        return replace(self, correlation=np.where(usable, self.correlation, np.float32(np.nan)))

    def where(self, rows: BoolArray, shift: int = 0) -> CorrelationTable:
        """Subset of the pairs, their frames numbered `shift` higher."""
        table = CorrelationTable(*(column[rows] for column in self._columns))
        return replace(table, first=table.first + shift, second=table.second + shift)

    def joins(self, frames: BoolArray) -> BoolArray:
        """Mask of pairs both of whose frames are among some, shape (e,)."""
        return np.asarray(frames[self.first] & frames[self.second])

    @classmethod
    def joined(cls, tables: Sequence[CorrelationTable]) -> CorrelationTable:
        """All pairs of several tables, one at least, in their order."""
        return cls(*(np.concatenate(columns) for columns in zip(*(t._columns for t in tables), strict=True)))

    @property
    def _columns(self) -> tuple[Any, ...]:
        return self.first, self.second, self.correlation, self.inplane, self.inplane_covariance

    def unmatched(self, frames: int, least_correlation: float) -> BoolArray:
        """Frames after the first that resemble none of those they were matched with, shape (frames,)."""
        best = np.full(frames, -np.inf)
        np.maximum.at(best, self.second, self.median)
        best[0] = np.inf
        return best < least_correlation
