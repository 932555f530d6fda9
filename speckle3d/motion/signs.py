"""Signs: on which side of each other frames lie, from unsigned planes, settled over the whole sweep.

A distance has no sign. A frame is placed against several earlier ones at once, and only one side of them
agrees with all the offsets and slopes. Where a pause or a turn leaves more than one path open, all of them
are followed until the frames that come later tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.kernels.signs import PathRules, follow_paths
from speckle3d.motion.planes import PairPlanes

HYPOTHESES = 8
PLAIN_ERROR, ADAPTED_ERROR = 0.25, 0.1
"""Relative error of distances by a phantom's curves and with coherence adapted to. Coherent tissue makes long
distances too short, so that a misfit of a quarter is no sign of turning back."""
TREND_MM = 0.3
"""Travel over which a direction is remembered: a few frames of a hand-held sweep."""
TURNING_COST = 2.0
"""Squared deviations by which the planes must speak for turning back: hands turn back rarely."""
CAP = 9.0
"""Squared deviations beyond which a pair disagrees altogether: it may be wrong."""
PLACED = 2.0
"""Variance of an offset between frames over a pair's own: the earlier frame was placed by such pairs, too."""
SAME_MM, SAME_SLOPE = 0.05, 0.005
"""Paths that end this close to each other at all frames still of use are one."""
APART_SLOPE = 0.01
"""Frames that turn more than this against each other may differ although their centres meet."""
APART_COST = 4.0
"""Squared deviations for a frame placed where it would resemble one that it does not resemble: less than
`CAP`, because tissue that moved or a lost contact do that, too."""
OPEN_FRAMES = 400
"""Paths may differ over this many frames, some twenty millimetres; before, the best one so far stands."""


@dataclass(frozen=True)
class SignedPairs:
    """Planes of frame pairs, and on which side of the first frame they lie.

    Attributes
    ----------
    row : ndarray of int, shape (e,)
        Of each pair in its `CorrelationTable`.
    first, second : ndarray of int, shape (e,)
        Its frames.
    planes : PairPlanes
    sign : ndarray, shape (e,)
        +1 or -1.
    """

    row: IntArray
    first: IntArray
    second: IntArray
    planes: PairPlanes
    sign: FloatArray

    def __len__(self) -> int:
        return int(self.row.size)

    def __getitem__(self, pairs: IntArray | BoolArray | slice) -> SignedPairs:
        """Return some of the pairs."""
        return SignedPairs(
            self.row[pairs],
            self.first[pairs],
            self.second[pairs],
            self.planes[pairs],
            self.sign[pairs],
        )

    @property
    def signless(self) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Frames, offset and slope along x of the planes, and their covariance, for `settled_path`."""
        moved, covariance = self.planes.coefficients[:, :2], self.planes.covariance[:, :2, :2]
        return self.first, self.second, moved, covariance

    def with_signs(self, sign: FloatArray) -> SignedPairs:
        """Return the same planes on other sides."""
        return replace(self, sign=sign)

    def and_also(self, others: SignedPairs) -> SignedPairs:
        """Return these pairs and others, in the order of their second and then their first frames."""
        if not len(others):
            return self
        every = SignedPairs(
            np.concatenate([self.row, others.row]),
            np.concatenate([self.first, others.first]),
            np.concatenate([self.second, others.second]),
            self.planes.followed_by(others.planes),
            np.concatenate([self.sign, others.sign]),
        )
        return every[np.lexsort((every.first, every.second))]


@dataclass(frozen=True)
class Strangers:
    """Pairs of frames that do not resemble each other, and so are not near each other.

    Attributes
    ----------
    first, second : ndarray of int, shape (u,)
        The earlier and the later frame; sorted by the later.
    apart_mm : float
        How far they are from each other at least.
    """

    first: IntArray
    second: IntArray
    apart_mm: float


def settled_path(
    frames: int,
    first: IntArray,
    second: IntArray,
    moved: FloatArray,
    covariance: FloatArray,
    relative_error: float = PLAIN_ERROR,
    strangers: Strangers | None = None,
    hold: bool = False,
    known: FloatArray | None = None,
) -> FloatArray:
    """Follow the most likely paths: elevational position and slope along x of one frame after the other.

    A frame is placed by its planes against earlier frames, of which the latest settles the direction. The
    sweep's first motion counts as positive.

    Parameters
    ----------
    frames : int
        Of the sweep.
    first, second : ndarray of int, shape (e,)
        Frames of each pair, sorted by the second.
    moved : ndarray, shape (e, 2)
        Offset and slope along x of each pair's plane, whose signs belong together.
    covariance : ndarray, shape (e, 2, 2)
    relative_error : float
        Of offsets and slopes, besides their covariance: `PLAIN_ERROR` or `ADAPTED_ERROR`.
    strangers : Strangers, optional
    hold : bool
        Leave frames that no pair places where the one before them is; else they stay at zero.
    known : ndarray, shape (m, 2), optional
        Position and slope of the first m frames, which stay.

    Returns
    -------
    ndarray, shape (n, 2)
        Position and slope of every frame on the best path.
    """
    none = np.zeros(0, dtype=np.int64)
    apart = strangers or Strangers(none, none, 0.0)
    rules = PathRules(
        HYPOTHESES,
        relative_error,
        PLACED,
        CAP,
        TURNING_COST,
        TREND_MM,
        SAME_MM,
        SAME_SLOPE,
        apart.apart_mm,
        APART_SLOPE,
        APART_COST,
        OPEN_FRAMES,
        hold,
    )
    every = np.arange(frames + 1)
    path = np.zeros((frames, 2))
    begun, trend = 1, 1.0
    if known is not None and len(known) > 1:
        begun, trend = len(known), _trend(known[:, 0])
        path[:begun] = known
    follow_paths(
        np.searchsorted(second, every),
        np.ascontiguousarray(first),
        np.ascontiguousarray(moved),
        np.ascontiguousarray(covariance),
        np.searchsorted(apart.second, every),
        np.ascontiguousarray(apart.first),
        rules,
        path,
        begun,
        trend,
    )
    return path


def _trend(position_mm: FloatArray) -> float:
    """Direction in which frames went at last, averaged over travel as `follow_paths` does."""
    step = np.diff(position_mm)
    left = np.cumsum(np.abs(step[::-1]))[::-1]
    kept = np.exp(-np.append(left, 0.0) / TREND_MM)
    return float(kept[0] + np.sum(np.sign(step) * (kept[1:] - kept[:-1])))


def pair_signs(
    path: FloatArray, first: IntArray, second: IntArray, moved: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Sign of each pair's plane with which it agrees best with a path; shape (e,).

    Parameters
    ----------
    path : ndarray, shape (n, 2)
    first, second : ndarray of int, shape (e,)
    moved : ndarray, shape (e, 2)
        As for `settled_path`.
    covariance : ndarray, shape (e, 2, 2)
    """
    relative, weight = path[second] - path[first], np.linalg.inv(covariance)
    plus, minus = (
        np.einsum("ei,eij,ej->e", off, weight, off) for off in (relative - moved, relative + moved)
    )
    return np.where(plus <= minus, 1.0, -1.0)
