"""Signs: on which side of each other frames lie, from unsigned planes, settled over the whole sweep.

A distance has no sign. A frame is placed against several earlier ones at once, and only one side of them
agrees with all the offsets and slopes. Where a pause or a turn leaves more than one path open, all of them
are followed until the frames that come later tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from speckle3d.core.arrays import FloatArray, IntArray
from speckle3d.motion.planes import PairPlane

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


class SignResolver:
    """Follows the most likely paths: elevational position and slope along x of one frame after the other.

    Parameters
    ----------
    frames : int
        Of the sweep.
    relative_error : float
        Of offsets and slopes, besides their covariance: `PLAIN_ERROR` or `ADAPTED_ERROR`.

    Notes
    -----
    The sweep's first motion counts as positive.
    """

    def __init__(self, frames: int, relative_error: float = PLAIN_ERROR) -> None:
        self._relative_error = relative_error
        self._paths = np.zeros((1, frames, 2))
        self._cost = np.zeros(1)
        self._trend = np.ones(1)

    @property
    def path(self) -> FloatArray:
        """Position and slope of every frame on the best path so far, shape (n, 2), mm."""
        return np.asarray(self._paths[np.argmin(self._cost)])

    def place(
        self,
        frame: int,
        first: Sequence[int],
        planes: Sequence[PairPlane],
        unlike: IntArray | None = None,
        apart_mm: float = 0.0,
    ) -> None:
        """Place a frame by its planes against earlier frames, of which the latest settles the direction.

        Parameters
        ----------
        unlike : ndarray of int, shape (k,), optional
            Earlier frames that it does not resemble, and so cannot be within `apart_mm` of.
        """
        at = np.asarray(first)
        here = self._paths[:, at]
        moved = np.array([p.coefficients[:2] for p in planes])
        weight = self._weights(planes, moved)
        candidates = np.concatenate([here + moved, here - moved], axis=1)
        misfit = _misfit(candidates[:, :, None] - here[:, None], moved, weight)[0]
        step = candidates[:, :, 0] - here[:, [int(np.argmax(at))], 0]
        cost = np.minimum(misfit, CAP).sum(axis=2) + TURNING_COST * (step * self._trend[:, None] < 0)
        if unlike is not None and unlike.size:
            near = np.abs(candidates[:, :, None] - self._paths[:, None, unlike])
            same = (near[..., 0] < apart_mm) & (near[..., 1] < APART_SLOPE)
            cost = cost + APART_COST * same.sum(axis=2)
        if not self._paths.any():
            # The overall sign is open: of two mirror images one is enough.
            cost = np.where(candidates[:, :, 0] < 0, np.inf, cost)
        self._keep(frame, self._cost[:, None] + cost, here, moved, weight, candidates, int(np.argmax(at)))

    def hold(self, frame: int) -> None:
        """Leave a frame that no plane places where the one before it is."""
        self._paths[:, frame] = self._paths[:, frame - 1]

    def _weights(self, planes: Sequence[PairPlane], moved: FloatArray) -> FloatArray:
        """Inverse covariances of offsets and slopes, shape (e, 2, 2)."""
        covariance = PLACED * np.array([p.covariance[:2, :2] for p in planes])
        covariance[:, [0, 1], [0, 1]] += (self._relative_error * moved) ** 2
        return np.asarray(np.linalg.inv(covariance))

    def _keep(
        self,
        frame: int,
        cost: FloatArray,
        here: FloatArray,
        moved: FloatArray,
        weight: FloatArray,
        candidates: FloatArray,
        latest: int,
    ) -> None:
        """Go on with the best paths that differ."""
        recent = max(0, frame - OPEN_FRAMES)
        kept: list[tuple[int, FloatArray]] = []
        paths: list[FloatArray] = []
        costs: list[float] = []
        for flat in np.argsort(cost, axis=None)[: 4 * HYPOTHESES]:
            parent, which = np.unravel_index(flat, cost.shape)
            if not np.isfinite(cost[parent, which]) or len(kept) == HYPOTHESES:
                break
            place = _refined(candidates[parent, which], here[parent], moved, weight)
            seen = np.vstack([here[parent], place])
            others = (np.abs(path - seen).max(axis=0) for path in paths)
            if not any(o[0] < SAME_MM and o[1] < SAME_SLOPE for o in others):
                kept.append((int(parent), place))
                paths.append(seen)
                costs.append(float(cost[parent, which]))
        parents = np.array([p for p, _ in kept])
        places = np.array([x for _, x in kept])
        self._advance(frame, recent, parents, places, np.array(costs), here[parents, latest, 0])

    def _advance(
        self,
        frame: int,
        recent: int,
        parents: IntArray,
        places: FloatArray,
        cost: FloatArray,
        before: FloatArray,
    ) -> None:
        paths = self._paths[parents]
        paths[:, :recent] = self.path[:recent]
        paths[:, frame] = places
        step = places[:, 0] - before
        # Averaged over travel and not over time, so that a pause, whose steps have random signs, keeps it.
        share = 1.0 - np.exp(-np.abs(step) / TREND_MM)
        trend = self._trend[parents]
        self._trend = trend + share * (np.sign(step) - trend)
        self._paths, self._cost = paths, cost - cost.min()


def pair_signs(
    path: FloatArray, first: IntArray, second: IntArray, planes: Sequence[PairPlane]
) -> FloatArray:
    """Sign of each pair's plane with which it agrees best with a path; shape (e,)."""
    moved = np.array([p.coefficients[:2] for p in planes])
    weight = np.linalg.inv(np.array([p.covariance[:2, :2] for p in planes]))
    _, sign = _misfit((path[second] - path[first])[:, None], moved[:, None], weight[:, None])
    return np.asarray(sign[:, 0])


def _misfit(relative: FloatArray, moved: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared deviations of signed planes from unsigned ones, and the signs that make them least."""
    off = [relative - moved, relative + moved]
    plus, minus = (np.einsum("...i,...ij,...j->...", o, weight, o) for o in off)
    return np.minimum(plus, minus), np.where(plus <= minus, 1.0, -1.0)


def _refined(place: FloatArray, here: FloatArray, moved: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted mean of where the pairs that agree with a candidate put the frame."""
    misfit, sign = _misfit(place - here, moved, weight)
    near = misfit < CAP
    if not near.any():
        return place
    told = here[near] + sign[near, None] * moved[near]
    total = weight[near].sum(axis=0)
    return np.asarray(np.linalg.solve(total, np.einsum("eij,ej->i", weight[near], told)))
