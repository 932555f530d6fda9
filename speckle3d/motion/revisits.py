"""Ties between visits of the same tissue, for a sweep that comes back.

Speckle that was seen before is seen again, so that frames of a later visit have a distance from those of an
earlier one however far the probe travelled between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.estimate import Motion, planes_of
from speckle3d.motion.planes import PairPlanes
from speckle3d.motion.signs import SignedPairs

AWAY_MM = 3.0
"""Travel between two visits: less is within reach of the pairs measured anyway."""
REACH_MM, REACH_PER_MM = 0.4, 0.02
"""How far off a return may be found: speckle's range, and drift with travel."""
SPACING_MM = 0.15
MOST_CANDIDATES = 16
LEAST_PAIRS = 4
CAP, MARGIN = 9.0, 6.0
"""Squared deviations at which a pair counts as wrong, and by which a place must beat any other."""
BEYOND_MM, BEYOND_SIGMA_MM = 0.5, 0.1
"""Frames without common speckle are about this far apart or more."""
RELATIVE_ERROR, FIXED_ERROR_MM = 0.1, 0.02


@dataclass(frozen=True)
class Return:
    """A frame that may have come back to where earlier ones, nearest first, were."""

    frame: int
    earlier: Sequence[int]

    def pairs(self) -> Iterator[tuple[int, int]]:
        """Pairs to be matched, as first and second frame."""
        return ((first, self.frame) for first in self.earlier)


def find_returns(position_mm: FloatArray, every_mm: float) -> list[Return]:
    """Find frames, `every_mm` of travel apart, that are back where earlier ones were.

    Parameters
    ----------
    position_mm : ndarray, shape (n,)
        Elevational position of each frame's centre, right to a few hundredths of the travel.
    every_mm : float
        Zero: none are looked for.
    """
    if every_mm == 0:
        return []
    travel = _travel(position_mm)
    found: list[Return] = []
    for frame in _maybe_back(position_mm, travel):
        if found and travel[frame] - travel[found[-1].frame] < every_mm:
            continue
        earlier = _candidates(frame, position_mm, travel)
        if len(earlier) >= LEAST_PAIRS:
            found.append(Return(frame, earlier))
    return found


def tie_returns(returns: Sequence[Return], motion: Motion, table: CorrelationTable) -> SignedPairs:
    """Pairs of returns with the frames they came back to, where these agree on one place for the return.

    Parameters
    ----------
    table : CorrelationTable
        Holds the pairs of the returns, among others; a pair below `least_correlation` shows that its frames
        are far apart.
    """
    problem, position_mm = motion.problem, motion.path[:, 0]
    wanted = {pair for each in returns for pair in each.pairs()}
    every = zip(table.first.tolist(), table.second.tolist(), strict=True)
    rows = {pair: row for row, pair in enumerate(every) if pair in wanted} if wanted else {}
    alike = [row for row in rows.values() if table.median[row] >= problem.trajectory.least_correlation]
    # Structure is taken as the earlier visit has it.
    read = planes_of(problem, table, np.array(alike, dtype=np.int64), motion.coherence)
    read = replace(read, planes=read.planes.scaled(motion.scale))
    at = {row: k for k, row in enumerate(read.row.tolist())}
    travel, sign = _travel(position_mm), np.zeros(len(read))
    for each in returns:
        known = np.array([at.get(rows[pair], -1) for pair in each.pairs()])
        if (known >= 0).sum() >= LEAST_PAIRS:
            place = _agreed(each, known, read.planes, position_mm, travel)
            if place is not None:
                told = known[known >= 0]
                sign[told] = np.where(place >= position_mm[read.first[told]], 1.0, -1.0)
    return read.with_signs(sign)[sign != 0]


def _travel(position_mm: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position_mm)))])


def _maybe_back(position_mm: FloatArray, travel: FloatArray) -> list[int]:
    """Frames within reach of the range of positions that the path had covered before it was away."""
    before = np.searchsorted(travel, travel - AWAY_MM)
    reach = REACH_MM + REACH_PER_MM * travel
    low = np.minimum.accumulate(position_mm)[before - 1] - reach
    high = np.maximum.accumulate(position_mm)[before - 1] + reach
    return np.flatnonzero((before > 0) & (position_mm > low) & (position_mm < high)).tolist()


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


def _agreed(
    each: Return, known: IntArray, planes: PairPlanes, position_mm: FloatArray, travel: FloatArray
) -> float | None:
    """Place of a return on which its pairs agree; None if there is none.

    Parameters
    ----------
    known : ndarray of int, shape (c,)
        Which of the planes is that of each earlier frame; -1 for none.
    """
    earlier = list(each.earlier)
    reach = REACH_MM + REACH_PER_MM * float(np.ptp(travel[[*earlier, each.frame]]))
    offset = np.where(known >= 0, planes.offset_mm[known], np.nan)
    apart = position_mm[each.frame] - position_mm[earlier]
    shift = _place(apart, offset, planes.covariance[known, 0, 0], reach)
    return None if shift is None else float(position_mm[each.frame] + shift)


def _place(
    apart_mm: FloatArray, offset_mm: FloatArray, variance: FloatArray, reach_mm: float
) -> float | None:
    """Shift of a frame at which all its distances agree; None if no place is clearly the best.

    Parameters
    ----------
    apart_mm : ndarray, shape (c,)
        Signed distance from each candidate as the path has it.
    offset_mm, variance : ndarray, shape (c,)
        Unsigned distance as it was read, NaN for candidates without common speckle, and its variance.
    """
    shifts = np.arange(-reach_mm, reach_mm + 0.01, 0.02)
    distance = np.abs(apart_mm[:, None] + shifts)
    sigma = np.sqrt(variance + (RELATIVE_ERROR * offset_mm) ** 2 + FIXED_ERROR_MM**2)
    read = (distance - offset_mm[:, None]) / sigma[:, None]
    beyond = np.maximum(BEYOND_MM - distance, 0.0) / BEYOND_SIGMA_MM
    misfit = np.where(np.isnan(offset_mm)[:, None], beyond, read)
    cost = np.minimum(misfit**2, CAP).sum(axis=0)
    best = int(np.argmin(cost))
    others = np.abs(shifts - shifts[best]) > SPACING_MM
    if others.any() and cost[others].min() - cost[best] < MARGIN:
        return None
    return float(shifts[best])
