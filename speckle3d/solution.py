"""Second reading of a sweep, of its correlations alone: distances, planes, trajectories."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import FloatArray, mirrored
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.streams import BoolArray
from speckle3d.direction import sensed_orientation, settle_direction
from speckle3d.motion.coherence import CURVES_SIGMA, Coherence, estimate_coherence
from speckle3d.motion.distances import EchoModel, PatchDistances
from speckle3d.motion.patches import IntArray
from speckle3d.motion.planes import PairPlane
from speckle3d.motion.signs import SignResolver, pair_signs
from speckle3d.motion.subset import consistent_subset
from speckle3d.motion.slopes import SlopeEvidence, weigh_slopes
from speckle3d.motion.trajectory import PairMeasurement, SignedPair, sign_pair, solve_trajectory
from speckle3d.walk import StageTimes, Walk
PairSink = Callable[[FramePairs], None]
"""Called with some pairs at a time, in the order of their second frames, once the signs are settled."""
SINK_PAIRS = 1024
ADAPTED_ERROR = 0.1
"""Relative error of distances where coherence has been adapted to, for the choice of signs."""
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
        How the patches' echoes depart from a phantom's; None if not adapted to.
    slopes : SlopeEvidence
        What the images' own yaw and tilt are worth.
    """

    image: RigidTransform
    subset: RigidTransform | None
    rejected_share: float
    unreliable: tuple[int, ...]
    pairs: int
    direction: int
    direction_from: str
    coherence: Coherence | None
    slopes: SlopeEvidence
    times: StageTimes


class Solution:
    """Second reading, of the correlations alone: distances, planes, trajectories."""

    def __init__(self, walk: Walk, curves: DecorrelationCurves) -> None:
        self._walk, self._config, self._curves = walk, walk.config, curves
        self._estimator, self._matcher = walk.estimator, walk.matcher
        self._frames = len(walk.sweep)
        self._first, self._second = walk.table.first, walk.table.second
        self._rho = walk.table.correlation

    def solve(self, sink: PairSink | None) -> Tracked:
        """Trajectories from all usable pairs.

        Raises
        ------
        InsufficientDataError
            If most frames share too little speckle with any other.
        """
        walk = self._walk
        if len(walk.unreliable) > MOST_UNRELIABLE * self._frames:
            raise InsufficientDataError(
                f"{walk.sweep.name}: expected neighbouring frames to share speckle, got "
                f"{len(walk.unreliable)} of {self._frames} frames that share too little with any earlier one"
            )
        measured, coherence = self._adapted()
        then = time.perf_counter()
        slopes = self._evidence(measured, coherence)
        pairs = [self._signed(m, slopes.applied(m.plane)) for m in measured]
        image = self._trajectory(pairs)
        direction, source = settle_direction(walk.sweep, image, self._config)
        walk.times.add("trajectory", then)
        subset, used = self._consistent(measured, direction)
        if direction < 0:
            image, subset = mirrored(image), mirrored(subset) if subset is not None else None
        if sink:
            for start in range(0, len(pairs), SINK_PAIRS):
                some = slice(start, start + SINK_PAIRS)
                sink(self._rows(measured[some], pairs[some], used[some], direction))
        rejected = sum(int((m.known & ~u).sum()) for m, u in zip(measured, used, strict=True))
        return Tracked(
            image,
            subset,
            rejected / sum(int(m.known.sum()) for m in measured) if subset is not None else float("nan"),
            tuple(walk.unreliable),
            len(pairs),
            direction,
            source,
            coherence,
            slopes,
            walk.times,
        )

    def _adapted(self) -> tuple[list[_Measured], Coherence | None]:
        """Signed planes of all usable pairs, read with what the sweep itself says of its echoes.

        Twice: how echoes depart from a phantom's shows once distances are known, and the other way round.
        """
        path, coherence = self._walk.path, None
        if not self._config.coherence.adapt:
            return self._measure(path, None), None
        for known_scale in (False, True):
            then = time.perf_counter()
            coherence, path = estimate_coherence(
                self._first,
                self._second,
                self._rho,
                path,
                self._curves,
                self._matcher.patches,
                self._matcher.at_mm[:, 0],
                self._config.coherence,
                known_scale,
            )
            self._walk.times.add("coherence", then)
            measured = self._measure(path, coherence)
            slopes = self._evidence(measured, coherence)
            path = self._path_of(
                self._trajectory([self._signed(m, slopes.applied(m.plane)) for m in measured])
            )
        return measured, coherence

    def _measure(self, path: FloatArray, coherence: Coherence | None) -> list[_Measured]:
        """Planes of the pairs that are near enough on a path, and their signs."""
        then = time.perf_counter()
        chosen = self._choose(path[:, 0])
        first, second = self._first[chosen], self._second[chosen]
        models: Sequence[EchoModel | None] = [None] * chosen.size
        if coherence is not None:
            models = coherence.models((first + second) / 2, path[second, 0] - path[first, 0])
        found = []
        for row, i, j, model in zip(chosen, first, second, models, strict=True):
            rho = self._rho[row].astype(float)
            plane = self._walk.fitter.fit(rho, self._moved(row), model)
            if plane is not None:
                found.append(_Measured(row, int(i), int(j), model, plane, self._estimator.distances(rho, model)))
        signs = self._signs(found, ADAPTED_ERROR if coherence is not None else None)
        self._walk.times.add("distances and planes", then)
        return [replace(m, sign=sign) for m, sign in zip(found, signs, strict=True)]

    def _choose(self, position_mm: FloatArray) -> IntArray:
        """Pairs near enough to tell a distance: what would be left of fully developed speckle is enough."""
        least = self._config.trajectory.least_correlation
        distance = np.abs(position_mm[self._second] - position_mm[self._first])
        left = np.array([np.median(self._estimator.fully_developed(d)) for d in distance])
        near = left >= least
        # Every frame keeps its nearest pair, however little it tells.
        for frame in np.setdiff1d(np.arange(1, len(position_mm)), self._second[near]):
            rows = np.flatnonzero(self._second == frame)
            near[rows[np.argmax(left[rows])]] = True
        return np.flatnonzero(near)

    def _signs(self, measured: list[_Measured], relative_error: float | None) -> FloatArray:
        resolver = SignResolver(self._frames, *([] if relative_error is None else [relative_error]))
        start = 0
        second = np.array([m.second for m in measured])
        while start < len(measured):
            stop = int(np.searchsorted(second, second[start], side="right"))
            some = measured[start:stop]
            resolver.place(int(second[start]), [m.first for m in some], [m.plane for m in some])
            start = stop
        first = np.array([m.first for m in measured])
        return pair_signs(resolver.path, first, second, [m.plane for m in measured])

    def _moved(self, row: int) -> FloatArray:
        motion = self._walk.table.motion(row)
        return np.array([motion.x_mm, motion.y_mm])

    def _signed(self, measured: _Measured, plane: PairPlane) -> SignedPair:
        motion = self._walk.table.motion(measured.row)
        return sign_pair(PairMeasurement(measured.first, measured.second, motion, plane), measured.sign)

    def _trajectory(self, pairs: list[SignedPair]) -> RigidTransform:
        return solve_trajectory(pairs, self._frames, self._matcher.centre_mm, self._config.trajectory)

    def _path_of(self, poses: RigidTransform) -> FloatArray:
        """Elevational position of the image's centre and slope along x of every frame."""
        centre = self._matcher.centre_mm
        return np.column_stack([poses.apply(centre)[:, 2], poses.rotation.as_matrix()[:, 2, 0]])

    def _evidence(self, measured: list[_Measured], coherence: Coherence | None) -> SlopeEvidence:
        return weigh_slopes(
            [self._walk.fitter.design(self._moved(m.row)) for m in measured],
            [m.plane for m in measured],
            CURVES_SIGMA if coherence is None else coherence.scale_sigma,
            float(np.deg2rad(self._config.planes.turn_deg_per_mm)),
        )

    def _consistent(
        self, measured: list[_Measured], direction: int
    ) -> tuple[RigidTransform | None, list[BoolArray]]:
        """Trajectory from the orientation-consistent patches, and which those are, if orientation is sensed."""
        sensed = sensed_orientation(self._walk.sweep, self._config)
        if sensed is None:
            return None, [m.plane.used for m in measured]
        then = time.perf_counter()
        planes = []
        for m in measured:
            relative = (sensed[m.first].inv() * sensed[m.second]).as_matrix()
            slopes = direction * m.sign * relative[2, :2]
            raised = self._walk.fitter.design(self._moved(m.row))[:, 1:] @ slopes
            agreed = consistent_subset(m.distances, raised, self._config.planes.support_sigma)
            rho = self._rho[m.row].astype(float)
            plane = self._walk.fitter.fit(rho, self._moved(m.row), m.model, agreed.support, slopes)
            planes.append(plane or m.plane)
        self._walk.times.add("distances and planes", then)
        pairs = [self._signed(m, plane) for m, plane in zip(measured, planes, strict=True)]
        return self._trajectory(pairs), [plane.used for plane in planes]

    def _rows(
        self, measured: list[_Measured], signed: list[SignedPair], used: list[BoolArray], direction: int
    ) -> FramePairs:
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
            used=np.array(used),
            patch_centre_mm=self._matcher.patches.centre_mm,
        )


@dataclass(frozen=True)
class _Measured:
    """One pair of the second reading."""

    row: int
    first: int
    second: int
    model: EchoModel | None
    plane: PairPlane
    distances: PatchDistances
    sign: float = 1.0

    @property
    def known(self) -> BoolArray:
        """Patches that hold a distance."""
        return np.isfinite(self.distances.distance_mm)
