"""Pair correlations to signed planes, and signed planes to poses."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy

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
from speckle3d.motion.coherence import (
    Coherence,
    PairEchoes,
    PatchCorrelations,
    RowScales,
    estimate_coherence,
    scale_sigma,
)
from speckle3d.motion.curve_doubts import FLAT, sum_ratios
from speckle3d.motion.distances import LEAST_CORRELATION, DistanceEstimator, PatchDistances
from speckle3d.motion.planes import PairPlanes, PlaneFitter, PlaneSettings, consistent_subset
from speckle3d.motion.signs import (
    ADAPTED_ERROR,
    PLAIN_ERROR,
    SignedPairs,
    Strangers,
    pair_signs,
    settled_path,
)
from speckle3d.motion.trajectory import (
    Trajectory,
    fixed,
    held,
    joined,
    relative_poses_of,
    solve_trajectory,
)
from speckle3d.motion.uncertainty import SlopeEvidence, weigh_slopes

ROWS_AT_ONCE = 1024
ENOUGH_PAIRS = 3


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

    def of_frames(self, frames: int) -> PairReader:
        """Return a reader of the same images in another number."""
        other = copy(self)
        other._frames = frames
        return other

    def rough_path(self, table: CorrelationTable) -> FloatArray:
        """Place each frame after the earlier ones it resembles, by a phantom's curves.

        Returns
        -------
        ndarray, shape (n, 2)
            Elevational position of each frame's centre, mm, and its slope along x.
        """
        rows = self._alike(table)
        found, coefficients, covariance = [], [], []
        for some in _slices(rows, ROWS_AT_ONCE):
            planes = self.fitter.fit(table.correlation[some], table.inplane[some, :2])
            found.append(some[planes.determined])
            coefficients.append(planes.coefficients[planes.determined, :2])
            covariance.append(planes.covariance[planes.determined, :2, :2])
        rows = np.concatenate(found)
        return settled_path(
            self._frames,
            table.first[rows],
            table.second[rows],
            np.concatenate(coefficients),
            np.concatenate(covariance),
            strangers=self._strangers(table, np.ones(len(table), dtype=bool)),
            hold=True,
        )

    def measure(
        self,
        table: CorrelationTable,
        path: FloatArray,
        sound: BoolArray,
        coherence: Coherence | None,
        known: int = 0,
    ) -> SignedPairs:
        """Planes and signs of the pairs that are near enough on a path to tell a distance.

        Parameters
        ----------
        path : ndarray, shape (n, 2)
            Elevational position of each frame's centre and its slope along x.
        sound : ndarray of bool, shape (e,)
            Pairs both of whose frames are to be trusted.
        coherence : Coherence or None
            With which correlations are read; None for a phantom's curves as they are.
        known : int
            So many frames at the beginning are where the path has them.

        Raises
        ------
        InsufficientDataError
            If no pair determines a plane.
        """
        pairs = self.unsigned(table, path, sound, coherence)
        if not len(pairs):
            patches = table.correlation.shape[1]
            raise InsufficientDataError(
                f"expected frame pairs whose patches determine a plane, got none in {len(table)} pairs of "
                f"{patches} patches: is the image wide enough, and do the curves fit it?"
            )
        error = PLAIN_ERROR if coherence is None else ADAPTED_ERROR
        return self.signed(table, pairs, sound, path[:known, :2], error)[0]

    def unsigned(
        self, table: CorrelationTable, path: FloatArray, sound: BoolArray, coherence: Coherence | None
    ) -> SignedPairs:
        """Planes of the pairs as for `measure`, as far as they are determined; all signs are +1."""
        chosen = self._choose(table, path[:, 0], sound)
        first, second = table.first[chosen], table.second[chosen]
        apart = path[second, 0] - path[first, 0]
        echoes = None if coherence is None else PairEchoes(coherence, (first + second) / 2)
        planes = self.fitter.fit(
            table.correlation[chosen], table.inplane[chosen, :2], echoes, start_mm=np.abs(apart)
        )
        return SignedPairs(chosen, first, second, echoes, planes, np.ones(chosen.size))[planes.determined]

    def roughly(self, table: CorrelationTable, coherence: Coherence | None) -> SignedPairs:
        """Planes of frames' pairs with earlier frames that they resemble, wherever they are; all signs +1."""
        rows = self._alike(table)
        first, second = table.first[rows], table.second[rows]
        echoes = None if coherence is None else PairEchoes(coherence, (first + second) / 2)
        planes = self.fitter.fit(table.correlation[rows], table.inplane[rows, :2], echoes)
        return SignedPairs(rows, first, second, echoes, planes, np.ones(rows.size))[planes.determined]

    def signed(
        self,
        table: CorrelationTable,
        pairs: SignedPairs,
        sound: BoolArray,
        known: FloatArray,
        error: float = ADAPTED_ERROR,
    ) -> tuple[SignedPairs, FloatArray]:
        """Pairs with the signs that belong together, and the likeliest path, shape (n, 2).

        Parameters
        ----------
        known : ndarray, shape (m, 2)
            Path of the first m frames, which stays; of none, if the sweep begins with the table.
        error : float
            Of distances, as for `settled_path`.
        """
        moved, covariance = pairs.planes.coefficients[:, :2], pairs.planes.covariance[:, :2, :2]
        signless = pairs.first, pairs.second, moved, covariance
        settled = settled_path(
            self._frames, *signless, error, self._strangers(table, sound), hold=len(known) > 0, known=known
        )
        return pairs.with_signs(pair_signs(settled, *signless)), settled

    def coherence(
        self, table: CorrelationTable, path: FloatArray, sound: BoolArray
    ) -> tuple[Coherence, float, RowScales]:
        """Fit what stays of the patches' echoes, and the scale of the path; see `estimate_coherence`."""
        correlations = PatchCorrelations(
            table.first[sound],
            table.second[sound],
            table.correlation[sound],
            path,
            self._curves,
            self._patches,
            self.fitter.levers,
        )
        return estimate_coherence(correlations)

    def sum_ratios(self, pairs: SignedPairs) -> FloatArray:
        """Sums of two distances over the one that spans both; see `speckle3d.motion.curve_doubts`."""
        least = FLAT * float(self._estimator.typical_distance(np.sqrt(0.5)))
        return sum_ratios(pairs.first, pairs.second, pairs.sign * pairs.planes.offset_mm, least)

    def slopes(self, pairs: SignedPairs, coherence: Coherence | None) -> SlopeEvidence:
        """Weigh what the images see of yaw and tilt."""
        expected = float(np.deg2rad(self._planes.turn_deg_per_mm))
        return weigh_slopes(self.fitter.design(), pairs.planes, scale_sigma(coherence), expected)

    def edges(self, table: CorrelationTable, pairs: SignedPairs, planes: PairPlanes) -> RelativePoses:
        """Relative poses of pairs, from `planes` in place of their own."""
        return relative_poses_of(
            pairs.first,
            pairs.second,
            table.inplane[pairs.row],
            table.inplane_covariance[pairs.row],
            planes,
            pairs.sign,
        )

    def solve(self, edges: RelativePoses, with_covariance: bool = False) -> Trajectory:
        """Poses of all frames; those that no edge joins to earlier ones lie between their neighbours."""
        lone = np.flatnonzero(self.unjoined(edges.second))
        after = lone[lone + 1 < self._frames]
        between = held(np.concatenate([lone - 1, after]), np.concatenate([lone, after + 1]))
        return solve_trajectory(
            joined(edges, between), self._frames, self._centre, self._settings, with_covariance
        )

    def solve_onto(self, edges: RelativePoses, known: RigidTransform) -> RigidTransform:
        """Poses of all frames from edges and the poses of the first frames, one at least, which stay."""
        if len(known) > 1:
            edges = joined(fixed(known, self._centre), edges)
        return RigidTransform.concatenate([known, (known[0] * self.solve(edges).poses)[len(known) :]])

    def path_of(self, poses: RigidTransform) -> FloatArray:
        """Elevational position of the image's centre and slopes along x and y of every pose, shape (n, 3)."""
        return np.column_stack([poses.apply(self._centre)[:, 2], poses.rotation.as_matrix()[:, 2, :2]])

    def unjoined(self, second: IntArray) -> BoolArray:
        """Frames after the first that are the second of no pair, shape (n,)."""
        lone = np.ones(self._frames, dtype=bool)
        lone[0] = False
        lone[second] = False
        return lone

    def path(self, table: CorrelationTable, pairs: SignedPairs, coherence: Coherence | None) -> FloatArray:
        """Elevational position and slopes along x and y of every frame, shape (n, 3)."""
        slopes = self.slopes(pairs, coherence)
        return self.path_of(self.solve(self.edges(table, pairs, slopes.applied(pairs.planes))).poses)

    def consistent(
        self, table: CorrelationTable, pairs: SignedPairs, sensed: Rotation, direction: int
    ) -> PairPlanes:
        """Planes of the sensed orientation, through the patches that agree with it; their own if too few do.

        Parameters
        ----------
        sensed : Rotation, length n
            Orientation of every frame.
        direction : int
            Sign of the elevational motion, with which that of every pair is multiplied.
        """
        relative = (sensed[pairs.first].inv() * sensed[pairs.second]).as_matrix()[:, 2, :2]
        moved, slopes = table.inplane[pairs.row, :2], direction * pairs.sign[:, None] * relative
        offset, correlation = pairs.planes.offset_mm, table.correlation[pairs.row]
        agreed = np.empty(correlation.shape, dtype=bool)
        open_side = np.empty(len(pairs), dtype=bool)
        for some in _slices(np.arange(len(pairs)), ROWS_AT_ONCE):
            raised = self.fitter.raised(moved[some], slopes[some])
            # Only frames that cross, or nearly, leave the side open.
            open_side[some] = offset[some] < np.ptp(raised, axis=1)
            distances = self._distances(table, pairs[some])
            agreed[some] = consistent_subset(distances, raised, self._planes.support_sigma, open_side[some])
        planes = self.fitter.fit(correlation, moved, pairs.echoes, agreed, slopes, offset, open_side)
        return planes.where(planes.determined, pairs.planes)

    def rows(
        self,
        table: CorrelationTable,
        pairs: SignedPairs,
        edges: RelativePoses,
        used: BoolArray,
        direction: int,
        scale_sigma: float,
    ) -> Iterator[FramePairs]:
        """Pairs for the reconstruction file; deviations include that of the scale, which patches share."""
        centre = RigidTransform.from_translation(self._centre)
        flip = np.diag([1.0, 1.0, direction, 1.0])
        turn = MIRROR if direction < 0 else np.eye(6)
        for some in _slices(np.arange(len(pairs)), ROWS_AT_ONCE):
            d = self._distances(table, pairs[some])
            yield FramePairs(
                first=edges.first[some],
                second=edges.second[some],
                first_from_second=flip @ (centre * edges.poses[some] * centre.inv()).as_matrix() @ flip,
                covariance=turn @ edges.covariance[some] @ turn,
                distance_mm=d.distance_mm.astype(np.float32),
                sigma_mm=np.hypot(d.sigma_mm, scale_sigma * d.distance_mm).astype(np.float32),
                used=used[some],
                patch_centre_mm=self._patches.centre_mm,
            )

    def _alike(self, table: CorrelationTable) -> IntArray:
        """Rows of frames' pairs with earlier frames that they resemble; without any, of their best pair."""
        alike = table.median >= self._settings.least_correlation
        best_first = np.lexsort((-table.median, table.second))
        frame, best = np.unique(table.second[best_first], return_index=True)
        without = ~np.isin(frame, table.second[alike])
        alike[best_first[best[without]]] = True
        return np.flatnonzero(alike)

    def _choose(self, table: CorrelationTable, position_mm: FloatArray, sound: BoolArray) -> IntArray:
        """Rows of pairs so near that fully developed speckle would keep enough correlation."""
        distance = np.abs(position_mm[table.second] - position_mm[table.first])
        left = self._estimator.typical_correlation(distance)
        near = (left >= self._settings.clear_correlation) & sound
        # Frames without enough of them take those that tell less, and if need be one that tells little.
        pairs = np.bincount(table.second[near], minlength=self._frames)
        near |= (left >= self._settings.least_correlation) & sound & (pairs[table.second] < ENOUGH_PAIRS)
        for frame in np.setdiff1d(table.second[sound], table.second[near]):
            rows = np.flatnonzero((table.second == frame) & sound)
            best = rows[np.argmax(left[rows])]
            near[best] = table.median[best] >= LEAST_CORRELATION
        return np.flatnonzero(near)

    def _strangers(self, table: CorrelationTable, sound: BoolArray) -> Strangers:
        """Frames that were compared and do not resemble each other, and how far apart they are.

        Speckle at half the distance at which it keeps `least_correlation` would keep two thirds of it: no
        error of curves makes the one look like the other, and what stays of echoes only adds to it.
        """
        far = (table.median < self._settings.least_correlation) & sound
        half = 0.5 * float(self._estimator.typical_distance(np.sqrt(self._settings.least_correlation)))
        return Strangers(table.first[far], table.second[far], half)

    def _distances(self, table: CorrelationTable, pairs: SignedPairs) -> PatchDistances:
        model = None if pairs.echoes is None else pairs.echoes.models()
        return self._estimator.distances(table.correlation[pairs.row].astype(float), model)


def _slices(rows: IntArray, most: int) -> Iterator[IntArray]:
    """Rows, some at a time: once at least."""
    return (rows[start : start + most] for start in range(0, max(rows.size, 1), most))
