"""Pair correlations to signed planes, and signed planes to poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.arrays import BoolArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.relative import MIRROR, RelativePoses
from speckle3d.matching.patches import PatchGrid
from speckle3d.matching.schedule import TrajectorySettings
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.coherence import Coherence, CoherenceSettings, estimate_coherence, scale_sigma
from speckle3d.motion.curve_doubts import FLAT, DepthFactors, depth_factors, sum_ratios
from speckle3d.motion.distances import LEAST_CORRELATION, DistanceEstimator, EchoModel, PatchDistances
from speckle3d.motion.planes import PairPlane, PlaneFitter, PlaneSettings, consistent_subset
from speckle3d.motion.signs import ADAPTED_ERROR, PLAIN_ERROR, SignResolver, pair_signs
from speckle3d.motion.trajectory import (
    Trajectory,
    held,
    joined,
    relative_poses_of,
    solve_trajectory,
)
from speckle3d.motion.uncertainty import SlopeEvidence, weigh_slopes

ROWS_AT_ONCE = 1024
ENOUGH_PAIRS = 3


@dataclass(frozen=True)
class SignedPair:
    """The plane of one frame pair and on which side of the first frame it lies.

    Attributes
    ----------
    row : int
        Of the pair in its `CorrelationTable`.
    model : EchoModel or None
        With which its correlations are read; None for a phantom's curves as they are.
    sign : float
        +1 or -1.
    """

    row: int
    first: int
    second: int
    model: EchoModel | None
    plane: PairPlane
    sign: float = 1.0


class PairReader:
    """Reads the pair correlations of one sweep as planes, and planes as poses.

    Parameters
    ----------
    centre_mm : ndarray, shape (3,)
        The image's centre.
    frames : int
        Of the sweep.
    """

    def __init__(
        self,
        curves: DecorrelationCurves,
        patches: PatchGrid,
        centre_mm: FloatArray,
        frames: int,
        planes: PlaneSettings,
        trajectory: TrajectorySettings,
    ) -> None:
        self._curves, self._patches, self._centre, self._frames = curves, patches, centre_mm, frames
        self._planes, self._settings = planes, trajectory
        self._estimator = DistanceEstimator(curves, patches)
        self.fitter = PlaneFitter(self._estimator, patches.centre_mm - centre_mm[:2], planes)

    def with_curves(self, curves: DecorrelationCurves) -> PairReader:
        """Return a reader of the same sweep with other curves."""
        return PairReader(curves, self._patches, self._centre, self._frames, self._planes, self._settings)

    def rough_path(self, table: CorrelationTable) -> FloatArray:
        """Place each frame after the earlier ones it resembles, by a phantom's curves.

        Returns
        -------
        ndarray, shape (n, 2)
            Elevational position of each frame's centre, mm, and its slope along x.
        """
        signs = SignResolver(self._frames)
        for frame in range(1, self._frames):
            planes = {}
            for row in self._alike(table, frame):
                plane = self.fitter.fit(table.correlation[row].astype(float), table.moved_mm(row))
                if plane is not None:
                    planes[int(table.first[row])] = plane
            if planes:
                unlike, apart_mm = self._unlike(table, frame)
                signs.place(frame, list(planes), list(planes.values()), unlike, apart_mm)
            else:
                signs.hold(frame)
        return signs.path

    def measure(
        self, table: CorrelationTable, path: FloatArray, sound: BoolArray, coherence: Coherence | None
    ) -> list[SignedPair]:
        """Planes and signs of the pairs that are near enough on a path to tell a distance.

        Parameters
        ----------
        path : ndarray, shape (n, 2)
            Elevational position of each frame's centre and its slope along x.
        sound : ndarray of bool, shape (e,)
            Pairs both of whose frames are to be trusted.
        coherence : Coherence or None
            With which correlations are read; None for a phantom's curves as they are.

        Raises
        ------
        InsufficientDataError
            If no pair determines a plane.
        """
        chosen = self._choose(table, path[:, 0], sound)
        first, second = table.first[chosen], table.second[chosen]
        apart = path[second, 0] - path[first, 0]
        models: Sequence[EchoModel | None] = [None] * chosen.size
        if coherence is not None:
            models = coherence.models((first + second) / 2, apart)
        found = []
        for row, i, j, model, d in zip(chosen, first, second, models, apart, strict=True):
            rho = table.correlation[row].astype(float)
            plane = self.fitter.fit(rho, table.moved_mm(row), model, start_mm=abs(float(d)))
            if plane is not None:
                found.append(SignedPair(int(row), int(i), int(j), model, plane))
        if not found:
            patches = table.correlation.shape[1]
            raise InsufficientDataError(
                f"expected frame pairs whose patches determine a plane, got none in {chosen.size} pairs of "
                f"{patches} patches: is the image wide enough, and do the curves fit it?"
            )
        signs = self._signs(table, sound, found, PLAIN_ERROR if coherence is None else ADAPTED_ERROR)
        return [replace(pair, sign=float(sign)) for pair, sign in zip(found, signs, strict=True)]

    def coherence(
        self,
        table: CorrelationTable,
        path: FloatArray,
        sound: BoolArray,
        settings: CoherenceSettings,
        known_scale: bool,
    ) -> tuple[Coherence, FloatArray]:
        """Fit what stays of the patches' echoes and rescale the path; see `estimate_coherence`."""
        return estimate_coherence(
            table.first[sound],
            table.second[sound],
            table.correlation[sound],
            path,
            self._curves,
            self._patches,
            self._patches.centre_mm[:, 0] - self._centre[0],
            settings,
            known_scale,
        )

    def depth_factors(
        self, table: CorrelationTable, path: FloatArray, sound: BoolArray, settings: CoherenceSettings
    ) -> DepthFactors:
        """Distances read at each depth over those of all depths; see `speckle3d.motion.curve_doubts`."""
        lateral = self._patches.centre_mm[:, 0] - self._centre[0]
        return depth_factors(table, sound, path, self._curves, self._patches, lateral, settings)

    def sum_ratios(self, pairs: Sequence[SignedPair]) -> FloatArray:
        """Sums of two distances over the one that spans both; see `speckle3d.motion.curve_doubts`."""
        first, second = (np.array([getattr(pair, name) for pair in pairs]) for name in ("first", "second"))
        distance = np.array([pair.sign * pair.plane.offset_mm for pair in pairs])
        return sum_ratios(first, second, distance, FLAT * self._estimator.typical_distance(np.sqrt(0.5)))

    def slopes(self, pairs: Sequence[SignedPair], coherence: Coherence | None) -> SlopeEvidence:
        """Weigh what the images see of yaw and tilt."""
        return weigh_slopes(
            self.fitter.design(np.zeros(2)),
            [pair.plane for pair in pairs],
            scale_sigma(coherence),
            float(np.deg2rad(self._planes.turn_deg_per_mm)),
        )

    def edges(
        self, table: CorrelationTable, pairs: Sequence[SignedPair], planes: Sequence[PairPlane]
    ) -> RelativePoses:
        """Relative poses of pairs, from `planes` in place of their own."""
        return relative_poses_of(
            [pair.first for pair in pairs],
            [pair.second for pair in pairs],
            [table.motion[pair.row] for pair in pairs],
            planes,
            [pair.sign for pair in pairs],
        )

    def solve(self, edges: RelativePoses, with_covariance: bool = False) -> Trajectory:
        """Poses of all frames; those that no edge joins to earlier ones lie between their neighbours."""
        lone = np.flatnonzero(self.unjoined(edges.second))
        after = lone[lone + 1 < self._frames]
        between = held(np.concatenate([lone - 1, after]), np.concatenate([lone, after + 1]))
        return solve_trajectory(
            joined(edges, between), self._frames, self._centre, self._settings, with_covariance
        )

    def unjoined(self, second: IntArray) -> BoolArray:
        """Frames after the first that are the second of no pair, shape (n,)."""
        lone = np.ones(self._frames, dtype=bool)
        lone[0] = False
        lone[second] = False
        return lone

    def path(
        self, table: CorrelationTable, pairs: Sequence[SignedPair], coherence: Coherence | None
    ) -> FloatArray:
        """Elevational position of the image's centre and slope along x of every frame, shape (n, 2)."""
        slopes = self.slopes(pairs, coherence)
        poses = self.solve(self.edges(table, pairs, [slopes.applied(p.plane) for p in pairs])).poses
        return np.column_stack([poses.apply(self._centre)[:, 2], poses.rotation.as_matrix()[:, 2, 0]])

    def consistent(
        self, table: CorrelationTable, pairs: Sequence[SignedPair], sensed: Rotation, direction: int
    ) -> list[PairPlane]:
        """Planes of the sensed orientation, through the patches that agree with it.

        Parameters
        ----------
        sensed : Rotation, length n
            Orientation of every frame.
        direction : int
            Sign of the elevational motion, with which that of every pair is multiplied.
        """
        first, second = ([getattr(pair, name) for pair in pairs] for name in ("first", "second"))
        relative = (sensed[first].inv() * sensed[second]).as_matrix()[:, 2, :2]
        return [
            self._consistent_plane(table, pair, direction * pair.sign * slopes)
            for pair, slopes in zip(pairs, relative, strict=True)
        ]

    def rows(
        self,
        table: CorrelationTable,
        pairs: Sequence[SignedPair],
        edges: RelativePoses,
        used: Sequence[BoolArray],
        direction: int,
        scale_sigma: float,
    ) -> Iterator[FramePairs]:
        """Pairs for the reconstruction file; deviations include that of the scale, which patches share."""
        centre = RigidTransform.from_translation(self._centre)
        flip = np.diag([1.0, 1.0, direction, 1.0])
        turn = MIRROR if direction < 0 else np.eye(6)
        for start in range(0, len(pairs), ROWS_AT_ONCE):
            some = slice(start, start + ROWS_AT_ONCE)
            distances = [self._distances(table, pair) for pair in pairs[some]]
            sigma = [np.hypot(d.sigma_mm, scale_sigma * d.distance_mm) for d in distances]
            yield FramePairs(
                first=edges.first[some],
                second=edges.second[some],
                first_from_second=flip @ (centre * edges.poses[some] * centre.inv()).as_matrix() @ flip,
                covariance=turn @ edges.covariance[some] @ turn,
                distance_mm=np.array([d.distance_mm for d in distances], dtype=np.float32),
                sigma_mm=np.array(sigma, dtype=np.float32),
                used=np.array(used[some]),
                patch_centre_mm=self._patches.centre_mm,
            )

    def _alike(self, table: CorrelationTable, frame: int) -> IntArray:
        """Rows of a frame's pairs with earlier frames that it resembles; without any, of its best pair."""
        rows = np.arange(*np.searchsorted(table.second, [frame, frame + 1]))
        near = rows[table.median[rows] >= self._settings.least_correlation]
        return near if near.size else rows[[np.argmax(table.median[rows])]]

    def _choose(self, table: CorrelationTable, position_mm: FloatArray, sound: BoolArray) -> IntArray:
        """Rows of pairs so near that fully developed speckle would keep enough correlation."""
        distance = np.abs(position_mm[table.second] - position_mm[table.first])
        left = np.array([np.median(self._estimator.fully_developed(d)) for d in distance])
        near = (left >= self._settings.clear_correlation) & sound
        # Frames without enough of them take those that tell less, and if need be one that tells little.
        pairs = np.bincount(table.second[near], minlength=self._frames)
        near |= (left >= self._settings.least_correlation) & sound & (pairs[table.second] < ENOUGH_PAIRS)
        for frame in np.setdiff1d(table.second[sound], table.second[near]):
            rows = np.flatnonzero((table.second == frame) & sound)
            best = rows[np.argmax(left[rows])]
            near[best] = table.median[best] >= LEAST_CORRELATION
        return np.flatnonzero(near)

    def _unlike(
        self, table: CorrelationTable, frame: int, sound: BoolArray | None = None
    ) -> tuple[IntArray, float]:
        """Earlier frames that a frame was compared with and does not resemble, and how far it is from them.

        Speckle at half the distance at which it keeps `least_correlation` would keep two thirds of it: no
        error of curves makes the one look like the other, and what stays of echoes only adds to it.
        """
        rows = np.arange(*np.searchsorted(table.second, [frame, frame + 1]))
        far = table.median[rows] < self._settings.least_correlation
        if sound is not None:
            far &= sound[rows]
        half = 0.5 * self._estimator.typical_distance(float(np.sqrt(self._settings.least_correlation)))
        return table.first[rows[far]], half

    def _signs(
        self, table: CorrelationTable, sound: BoolArray, pairs: Sequence[SignedPair], relative_error: float
    ) -> FloatArray:
        resolver = SignResolver(self._frames, relative_error)
        second = np.array([pair.second for pair in pairs])
        start = 0
        while start < len(pairs):
            stop = int(np.searchsorted(second, second[start], side="right"))
            some = pairs[start:stop]
            frame = int(second[start])
            unlike = self._unlike(table, frame, sound)
            resolver.place(frame, [p.first for p in some], [p.plane for p in some], *unlike)
            start = stop
        first = np.array([pair.first for pair in pairs])
        return pair_signs(resolver.path, first, second, [pair.plane for pair in pairs])

    def _consistent_plane(self, table: CorrelationTable, pair: SignedPair, slopes: FloatArray) -> PairPlane:
        """Plane of known slopes through the patches that agree with them; the pair's own if too few do."""
        moved = table.moved_mm(pair.row)
        raised = self.fitter.design(moved)[:, 1:] @ slopes
        # Only frames that cross, or nearly, leave the side open.
        open_side = bool(pair.plane.offset_mm < np.ptp(raised))
        agreed = consistent_subset(
            self._distances(table, pair), raised, self._planes.support_sigma, open_side
        )
        rho = table.correlation[pair.row].astype(float)
        plane = self.fitter.fit(rho, moved, pair.model, agreed, slopes, pair.plane.offset_mm, open_side)
        return plane or pair.plane

    def _distances(self, table: CorrelationTable, pair: SignedPair) -> PatchDistances:
        return self._estimator.distances(table.correlation[pair.row].astype(float), pair.model)
