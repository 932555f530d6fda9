"""Second reading of a sweep, of its correlations alone: distances, planes, trajectories."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import mirrored
from speckle3d.core.reconstruction import FramePairs
from speckle3d.matching.blocks import StageTimes
from speckle3d.matching.quality import FrameFlag, describe, flag_frames
from speckle3d.motion.coherence import CURVES_SIGMA, Coherence, estimate_coherence
from speckle3d.motion.direction import sensed_orientation, settle_direction
from speckle3d.motion.distances import EchoModel, PatchDistances
from speckle3d.motion.path import Walk
from speckle3d.motion.planes import PairPlane
from speckle3d.motion.revisits import find_revisits
from speckle3d.motion.signs import SignResolver, pair_signs
from speckle3d.motion.slopes import SlopeEvidence, weigh_slopes
from speckle3d.motion.subset import consistent_subset
from speckle3d.motion.trajectory import (
    RelativePoses,
    Trajectory,
    held,
    joined,
    relative_poses_of,
    solve_trajectory,
)
from speckle3d.motion.uncertainty import pose_covariance

PairSink = Callable[[FramePairs], None]
"""Called with some pairs at a time, in the order of their second frames, once the signs are settled."""
SINK_PAIRS = 1024
ENOUGH_PAIRS = 3
ADAPTED_ERROR = 0.1
"""Relative error of distances where coherence has been adapted to, for the choice of signs."""
MOST_LOST = 0.3
"""Share of frames that may not be placed; with more, lengths are mostly guesses."""
MIRROR = np.diag([1.0, 1.0, -1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Tracked:
    """What the image-based stages found.

    Attributes
    ----------
    image : RigidTransform, length n
        Poses from all patches.
    covariance : ndarray, shape (n, 6, 6)
        Of `image`; see `speckle3d.motion.uncertainty`.
    subset : RigidTransform, length n, or None
        Poses from the orientation-consistent patches.
    rejected_share : float
        Share of measured patches outside the consistent subset; NaN without one.
    flags : ndarray of int, shape (n,)
        `FrameFlag` of every frame; zero for those to be trusted.
    direction_from : str
        What settled the sign of the elevational motion.
    coherence : Coherence or None
        How the patches' echoes depart from a phantom's; None if not adapted to.
    slopes : SlopeEvidence
        What the images' own yaw and tilt are worth.
    """

    image: RigidTransform
    covariance: FloatArray
    subset: RigidTransform | None
    rejected_share: float
    flags: IntArray
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
        self._flags = flag_frames(walk.features, walk.config.quality)
        self._flags[walk.unmatched] |= FrameFlag.UNMATCHED
        self._take_table()

    def _take_table(self) -> None:
        table = self._walk.table
        self._first, self._second, self._rho = table.first, table.second, table.correlation
        bad = (self._flags & ~FrameFlag.UNMATCHED) != 0
        self._sound = ~bad[self._first] & ~bad[self._second]

    def solve(self, sink: PairSink | None) -> Tracked:
        """Trajectories from all usable pairs.

        Raises
        ------
        InsufficientDataError
            If too many frames cannot be placed.
        """
        walk = self._walk
        self._require_enough()
        measured, coherence = self._adapted()
        measured = self._with_revisits(measured, coherence)
        then = time.perf_counter()
        slopes = self._evidence(measured, coherence)
        pairs = self._edges(measured, [slopes.applied(m.plane) for m in measured])
        trajectory = self._trajectory(pairs, with_covariance=True)
        image = trajectory.poses
        direction, source = settle_direction(walk.sweep, image, self._config)
        covariance = pose_covariance(
            image,
            trajectory.covariance,
            self._matcher.centre_mm,
            _scale_sigma(coherence),
            slopes,
            0.0 if coherence is None else float(coherence.share.mean()),
        )
        walk.times.add("trajectory", then)
        subset, used = self._consistent(measured, direction)
        if direction < 0:
            image, subset = mirrored(image), mirrored(subset) if subset is not None else None
            covariance = MIRROR @ covariance @ MIRROR
        if sink:
            for start in range(0, len(measured), SINK_PAIRS):
                some = slice(start, start + SINK_PAIRS)
                sink(self._rows(measured[some], pairs, some, used[some], direction, _scale_sigma(coherence)))
        rejected = sum(int((m.plane.used & ~u).sum()) for m, u in zip(measured, used, strict=True))
        return Tracked(
            image,
            covariance,
            subset,
            rejected / sum(int(m.plane.used.sum()) for m in measured) if subset is not None else float("nan"),
            self._flags,
            len(measured),
            direction,
            source,
            coherence,
            slopes,
            walk.times,
        )

    def _require_enough(self) -> None:
        lost = int((self._flags != 0).sum())
        if lost > MOST_LOST * self._frames:
            raise InsufficientDataError(
                f"{self._walk.sweep.name}: expected frames with speckle in common, got {lost} of "
                f"{self._frames} that cannot be placed: {'; '.join(describe(self._flags))}"
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
                self._first[self._sound],
                self._second[self._sound],
                self._rho[self._sound],
                path,
                self._curves,
                self._matcher.patches,
                self._matcher.at_mm[:, 0],
                self._config.coherence,
                known_scale,
            )
            self._walk.times.add("coherence", then)
            measured = self._measure(path, coherence)
            path = self._path(measured, coherence)
        return measured, coherence

    def _measure(self, path: FloatArray, coherence: Coherence | None) -> list[_Measured]:
        """Planes of the pairs that are near enough on a path, and their signs."""
        then = time.perf_counter()
        chosen = self._choose(path[:, 0])
        first, second = self._first[chosen], self._second[chosen]
        apart = path[second, 0] - path[first, 0]
        models: Sequence[EchoModel | None] = [None] * chosen.size
        if coherence is not None:
            models = coherence.models((first + second) / 2, apart)
        found = []
        for row, i, j, model, d in zip(chosen, first, second, models, apart, strict=True):
            rho = self._rho[row].astype(float)
            plane = self._walk.fitter.fit(rho, self._moved(row), model, start_mm=abs(float(d)))
            if plane is not None:
                found.append(_Measured(int(row), int(i), int(j), model, plane))
        signs = self._signs(found, ADAPTED_ERROR if coherence is not None else None)
        self._walk.times.add("distances and planes", then)
        return [replace(m, sign=float(sign)) for m, sign in zip(found, signs, strict=True)]

    def _choose(self, position_mm: FloatArray) -> IntArray:
        """Pairs near enough to tell a distance: what would be left of fully developed speckle is enough."""
        least = self._config.trajectory.least_correlation
        distance = np.abs(position_mm[self._second] - position_mm[self._first])
        left = np.array([np.median(self._estimator.fully_developed(d)) for d in distance])
        near = (left >= self._config.trajectory.clear_correlation) & self._sound
        # Frames without enough of them take those that tell less, and if need be one that tells little.
        pairs = np.bincount(self._second[near], minlength=self._frames)
        near |= (left >= least) & self._sound & (pairs[self._second] < ENOUGH_PAIRS)
        for frame in np.setdiff1d(self._second[self._sound], self._second[near]):
            rows = np.flatnonzero((self._second == frame) & self._sound)
            near[rows[np.argmax(left[rows])]] = True
        return np.flatnonzero(near)

    def _signs(self, measured: list[_Measured], relative_error: float | None) -> FloatArray:
        resolver = SignResolver(self._frames, *([] if relative_error is None else [relative_error]))
        second = np.array([m.second for m in measured])
        start = 0
        while start < len(measured):
            stop = int(np.searchsorted(second, second[start], side="right"))
            some = measured[start:stop]
            resolver.place(int(second[start]), [m.first for m in some], [m.plane for m in some])
            start = stop
        first = np.array([m.first for m in measured])
        return pair_signs(resolver.path, first, second, [m.plane for m in measured])

    def _with_revisits(self, measured: list[_Measured], coherence: Coherence | None) -> list[_Measured]:
        """Add pairs of frames from different visits of the same tissue, if the sweep comes back to any."""
        then = time.perf_counter()
        path = self._path(measured, coherence)
        rows = len(self._walk.table)
        revisits = [
            r
            for r in find_revisits(self._walk, path[:, 0], coherence)
            if not self._flags[r.first] and not self._flags[r.second]
        ]
        for r in revisits:
            self._walk.table.append(r.first, r.second, r.match)
        self._take_table()
        tied = [
            _Measured(row, r.first, r.second, r.model, r.plane, r.sign)
            for row, r in enumerate(revisits, start=rows)
        ]
        self._walk.times.add("revisits", then)
        return sorted([*measured, *tied], key=lambda m: (m.second, m.first))

    def _moved(self, row: int) -> FloatArray:
        motion = self._walk.table.motion(row)
        return np.array([motion.x_mm, motion.y_mm])

    def _edges(self, measured: list[_Measured], planes: Sequence[PairPlane]) -> RelativePoses:
        motions = [self._walk.table.motion(m.row) for m in measured]
        return relative_poses_of(
            [m.first for m in measured],
            [m.second for m in measured],
            motions,
            planes,
            [m.sign for m in measured],
        )

    def _trajectory(self, pairs: RelativePoses, with_covariance: bool = False) -> Trajectory:
        lone = np.setdiff1d(np.arange(1, self._frames), pairs.second)
        after = lone[lone + 1 < self._frames]
        self._flags[lone[self._flags[lone] == 0]] |= FrameFlag.UNMATCHED
        edges = joined(pairs, held(np.concatenate([lone - 1, after]), np.concatenate([lone, after + 1])))
        return solve_trajectory(
            edges, self._frames, self._matcher.centre_mm, self._config.trajectory, with_covariance
        )

    def _path(self, measured: list[_Measured], coherence: Coherence | None) -> FloatArray:
        """Elevational position of the image's centre and slope along x of every frame."""
        slopes, centre = self._evidence(measured, coherence), self._matcher.centre_mm
        poses = self._trajectory(self._edges(measured, [slopes.applied(m.plane) for m in measured])).poses
        return np.column_stack([poses.apply(centre)[:, 2], poses.rotation.as_matrix()[:, 2, 0]])

    def _evidence(self, measured: list[_Measured], coherence: Coherence | None) -> SlopeEvidence:
        return weigh_slopes(
            self._walk.fitter.design(np.zeros(2)),
            [m.plane for m in measured],
            _scale_sigma(coherence),
            float(np.deg2rad(self._config.planes.turn_deg_per_mm)),
        )

    def _consistent(
        self, measured: list[_Measured], direction: int
    ) -> tuple[RigidTransform | None, list[BoolArray]]:
        """Trajectory from the orientation-consistent patches, and which they are; None without a sensor."""
        sensed = sensed_orientation(self._walk.sweep, self._config)
        if sensed is None:
            return None, [m.plane.used for m in measured]
        then = time.perf_counter()
        planes = []
        first, second = ([getattr(m, name) for m in measured] for name in ("first", "second"))
        relative = (sensed[first].inv() * sensed[second]).as_matrix()[:, 2, :2]
        for m, each in zip(measured, relative, strict=True):
            slopes, moved = direction * m.sign * each, self._moved(m.row)
            raised = self._walk.fitter.design(moved)[:, 1:] @ slopes
            distances = self._distances(m)
            # Only frames that cross, or nearly, leave the side open.
            open_side = m.plane.offset_mm < np.ptp(raised)
            agreed = consistent_subset(distances, raised, self._config.planes.support_sigma, open_side)
            rho = self._rho[m.row].astype(float)
            plane = self._walk.fitter.fit(
                rho, moved, m.model, agreed.support, slopes, m.plane.offset_mm, open_side
            )
            planes.append(plane or m.plane)
        self._walk.times.add("distances and planes", then)
        return self._trajectory(self._edges(measured, planes)).poses, [plane.used for plane in planes]

    def _distances(self, measured: _Measured) -> PatchDistances:
        return self._estimator.distances(self._rho[measured.row].astype(float), measured.model)

    def _rows(
        self,
        measured: list[_Measured],
        pairs: RelativePoses,
        some: slice,
        used: list[BoolArray],
        direction: int,
        scale_sigma: float,
    ) -> FramePairs:
        """Rows for the reconstruction file; deviations include that of the scale, which patches share."""
        centre = RigidTransform.from_translation(self._matcher.centre_mm)
        flip = np.diag([1.0, 1.0, direction, 1.0])
        turn = np.diag([1.0, 1.0, direction, direction, direction, 1.0])
        distances = [self._distances(m) for m in measured]
        return FramePairs(
            first=pairs.first[some],
            second=pairs.second[some],
            first_from_second=flip @ (centre * pairs.poses[some] * centre.inv()).as_matrix() @ flip,
            covariance=turn @ pairs.covariance[some] @ turn,
            distance_mm=np.array([d.distance_mm for d in distances], dtype=np.float32),
            sigma_mm=np.array(
                [np.hypot(d.sigma_mm, scale_sigma * d.distance_mm) for d in distances], dtype=np.float32
            ),
            used=np.array(used),
            patch_centre_mm=self._matcher.patches.centre_mm,
        )


def _scale_sigma(coherence: Coherence | None) -> float:
    return CURVES_SIGMA if coherence is None else coherence.scale_sigma


@dataclass(frozen=True)
class _Measured:
    """One pair of the second reading."""

    row: int
    first: int
    second: int
    model: EchoModel | None
    plane: PairPlane
    sign: float = 1.0
