"""Second reading of a sweep, of its correlations alone: distances, planes, trajectories."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import mirrored
from speckle3d.core.reconstruction import FramePairs
from speckle3d.direction import sensed_orientation, settle_direction
from speckle3d.motion.coherence import Coherence, estimate_coherence
from speckle3d.motion.distances import EchoModel, PatchDistances
from speckle3d.motion.patches import IntArray
from speckle3d.motion.planes import PairPlane, consistent_subset, fit_plane
from speckle3d.motion.trajectory import PairMeasurement, SignedPair, sign_pair, solve_trajectory
from speckle3d.walk import StageTimes, Walk

PairSink = Callable[[FramePairs], None]
"""Called with some pairs at a time, in the order of their second frames, once the signs are settled."""
SINK_PAIRS = 1024
MOST_UNRELIABLE = 0.3
"""Share of frames that may lack a reliable neighbour; with more, lengths are mostly guesses."""


@dataclass(frozen=True)
class Tracked:
    """What the image-based stages found.

    Attributes
    ----------
    image : RigidTransform, length n
        Poses from all patches.
    subset : RigidTransform, length n, or None
        Poses from the orientation-consistent patches.
    rejected_share : float
        Share of measured patches outside the consistent subset; NaN without one.
    unreliable : ndarray of int
        Frames that no reliable pair joins to an earlier one.
    direction_from : str
        What settled the sign of the elevational motion.
    coherence : Coherence or None
        Coherent share and gain of the patches; None if not adapted to.
    """

    image: RigidTransform
    subset: RigidTransform | None
    rejected_share: float
    unreliable: tuple[int, ...]
    pairs: int
    direction: int
    direction_from: str
    coherence: Coherence | None
    times: StageTimes


class Solution:
    """Second reading, of the correlations alone: distances, planes, trajectories."""

    def __init__(self, walk: Walk, curves: DecorrelationCurves) -> None:
        self._walk, self._config = walk, walk.config
        self._estimator, self._matcher = walk.estimator, walk.matcher
        self._sensed = sensed_orientation(walk.sweep, walk.config)
        self._coherence: Coherence | None = None
        self._position = walk.position_mm
        self._counted = self._rejected = 0
        self._first, self._second = walk.table.first, walk.table.second
        self._rho = walk.table.correlation
        settings = walk.config.coherence
        if settings.adapt:
            then = time.perf_counter()
            self._coherence, self._position = estimate_coherence(
                self._first,
                self._second,
                self._rho,
                self._position,
                curves,
                self._matcher.patches,
                settings,
            )
            walk.times.add("coherence", then)

    def solve(self, sink: PairSink | None) -> Tracked:
        """Trajectories from all usable pairs.

        Raises
        ------
        InsufficientDataError
            If most frames share too little speckle with any other.
        """
        walk, frames = self._walk, len(self._walk.sweep)
        if len(walk.unreliable) > MOST_UNRELIABLE * frames:
            raise InsufficientDataError(
                f"{walk.sweep.name}: expected neighbouring frames to share speckle, got "
                f"{len(walk.unreliable)} of {frames} frames that share too little with any earlier one"
            )
        then = time.perf_counter()
        chosen = self._choose()
        models = self._models(chosen)
        tried = [self._measure(row, model) for row, model in zip(chosen, models, strict=True)]
        measured = [m for m in tried if m is not None]
        then = walk.times.add("distances and planes", then)
        centre = self._matcher.centre_mm
        pairs = [self._signed(m, m.plane) for m in measured]
        image = solve_trajectory(pairs, frames, centre, self._config.trajectory)
        subset = None
        if self._sensed is not None:
            kept = [self._signed(m, m.subset) for m in measured]
            subset = solve_trajectory(kept, frames, centre, self._config.trajectory)
        direction, source = settle_direction(walk.sweep, image, self._config)
        if direction < 0:
            image, subset = mirrored(image), mirrored(subset) if subset is not None else None
        if sink:
            for start in range(0, len(pairs), SINK_PAIRS):
                some = slice(start, start + SINK_PAIRS)
                sink(self._rows(measured[some], pairs[some], direction))
        walk.times.add("trajectory", then)
        return Tracked(
            image,
            subset,
            self._rejected / self._counted if self._counted else float("nan"),
            tuple(walk.unreliable),
            len(pairs),
            direction,
            source,
            self._coherence,
            walk.times,
        )

    def _choose(self) -> IntArray:
        """Pairs near enough to tell a distance: what would be left of fully developed speckle is enough."""
        least = self._config.trajectory.least_correlation
        distance = np.abs(self._position[self._second] - self._position[self._first])
        left = np.array([np.median(self._estimator.fully_developed(d)) for d in distance])
        near = left >= least
        # Every frame keeps its nearest pair, however little it tells.
        for frame in np.setdiff1d(np.arange(1, len(self._position)), self._second[near]):
            rows = np.flatnonzero(self._second == frame)
            near[rows[np.argmax(left[rows])]] = True
        return np.flatnonzero(near)

    def _models(self, chosen: IntArray) -> Iterator[EchoModel | None]:
        if self._coherence is None:
            yield from (None for _ in chosen)
            return
        first, second = self._first[chosen], self._second[chosen]
        shares, gains = self._coherence.at((first + second) / 2)
        distance = np.abs(self._position[second] - self._position[first])
        left = np.exp(-distance / self._coherence.structure_mm)
        for share, gain, h in zip(shares, gains, left, strict=True):
            yield EchoModel(share * h, 1 - share, gain)

    def _measure(self, row: int, model: EchoModel | None) -> _Measured | None:
        settings, motion = self._config.planes, self._walk.table.motion(row)
        at = self._matcher.at_mm - [motion.x_mm, motion.y_mm]
        first, second = int(self._first[row]), int(self._second[row])
        distances = self._estimator.distances(self._rho[row].astype(float), model)
        plane = fit_plane(distances, self._estimator, at, settings, model=model)
        subset = None
        if self._sensed is not None and plane is not None:
            relative = (self._sensed[first].inv() * self._sensed[second]).as_matrix()
            agreed = consistent_subset(distances, at, relative[2, :2], settings)
            subset = fit_plane(distances, self._estimator, at, settings, agreed.support, model, agreed.side)
            known = np.isfinite(distances.distance_mm)
            self._counted += int(known.sum())
            self._rejected += int((known & ~agreed.support).sum())
        return None if plane is None else _Measured(row, distances, plane, subset or plane)

    def _signed(self, measured: _Measured, plane: PairPlane) -> SignedPair:
        first, second = int(self._first[measured.row]), int(self._second[measured.row])
        sign = 1.0 if self._position[second] >= self._position[first] else -1.0
        pair = PairMeasurement(first, second, self._walk.table.motion(measured.row), plane)
        return sign_pair(pair, plane, sign)

    def _rows(self, measured: list[_Measured], signed: list[SignedPair], direction: int) -> FramePairs:
        """Rows for the reconstruction file."""
        centre = RigidTransform.from_translation(self._matcher.centre_mm)
        poses = RigidTransform.concatenate([centre * s.pose * centre.inv() for s in signed])
        turn = np.diag([1.0, 1.0, direction, direction, direction, 1.0])
        flip = np.diag([1.0, 1.0, direction, 1.0])
        return FramePairs(
            first=np.array([s.first for s in signed]),
            second=np.array([s.second for s in signed]),
            first_from_second=flip @ poses.as_matrix() @ flip,
            covariance=np.array([turn @ s.covariance @ turn for s in signed]),
            distance_mm=np.array([m.distances.distance_mm for m in measured], dtype=np.float32),
            sigma_mm=np.array([m.distances.sigma_mm for m in measured], dtype=np.float32),
            used=np.array([m.subset.used for m in measured]),
            patch_centre_mm=self._matcher.patches.centre_mm,
        )


@dataclass(frozen=True)
class _Measured:
    """One pair of the second reading; without a sensed orientation the subset's plane is that of all."""

    row: int
    distances: PatchDistances
    plane: PairPlane
    subset: PairPlane
