"""Ties between visits of the same tissue, for a sweep that comes back.

Speckle that was seen before is seen again, so that frames of a later visit have a distance from those of an
earlier one however far the probe travelled between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from speckle3d.core.arrays import FloatArray
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.coherence import Coherence
from speckle3d.motion.estimate import SignedPair
from speckle3d.motion.planes import PairPlane, PlaneFitter

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
    for frame in range(1, position_mm.size):
        if found and travel[frame] - travel[found[-1].frame] < every_mm:
            continue
        earlier = _candidates(frame, position_mm, travel)
        if len(earlier) >= LEAST_PAIRS:
            found.append(Return(frame, earlier))
    return found


def tie_returns(
    returns: Sequence[Return],
    table: CorrelationTable,
    position_mm: FloatArray,
    fitter: PlaneFitter,
    coherence: Coherence | None,
    least_correlation: float,
) -> list[SignedPair]:
    """Pairs of returns with the frames they came back to, where these agree on one place for the return.

    Parameters
    ----------
    table : CorrelationTable
        Holds the pairs of the returns, among others; a pair below `least_correlation` shows that its frames
        are far apart.
    position_mm : ndarray, shape (n,)
        As for `find_returns`.
    """
    rows = {
        pair: row for row, pair in enumerate(zip(table.first.tolist(), table.second.tolist(), strict=True))
    }
    travel = _travel(position_mm)
    ties: list[SignedPair] = []
    for each in returns:
        read: dict[int, SignedPair] = {}
        for pair in each.pairs():
            row = rows[pair]
            if table.median[row] >= least_correlation:
                one = _read(row, table, position_mm, fitter, coherence)
                if one is not None:
                    read[pair[0]] = one
        if len(read) >= LEAST_PAIRS:
            ties += _agreeing(each, read, position_mm, travel)
    return ties


def _travel(position_mm: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position_mm)))])


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


def _read(
    row: int,
    table: CorrelationTable,
    position_mm: FloatArray,
    fitter: PlaneFitter,
    coherence: Coherence | None,
) -> SignedPair | None:
    first, second = int(table.first[row]), int(table.second[row])
    model = None
    if coherence is not None:
        # Structure is what the earlier visit saw of it.
        apart = np.array([position_mm[second] - position_mm[first]])
        model = coherence.models(np.array([float(first)]), apart)[0]
    plane = fitter.fit(table.correlation[row].astype(float), table.moved_mm(row), model)
    return None if plane is None else SignedPair(row, first, second, model, plane)


def _agreeing(
    each: Return, read: Mapping[int, SignedPair], position_mm: FloatArray, travel: FloatArray
) -> list[SignedPair]:
    """Pairs of one return with their signs, if they agree on one place for it."""
    earlier = list(each.earlier)
    reach = REACH_MM + REACH_PER_MM * float(np.ptp(travel[[*earlier, each.frame]]))
    planes = [read[i].plane if i in read else None for i in earlier]
    shift = _place(position_mm[each.frame] - position_mm[earlier], planes, reach)
    if shift is None:
        return []
    at = position_mm[each.frame] + shift
    return [replace(pair, sign=1.0 if at >= position_mm[i] else -1.0) for i, pair in read.items()]


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
