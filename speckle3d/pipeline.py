"""The stages in order, streaming: RF sweep in, poses of every frame out.

RF -> intensity -> in-plane motion -> patch correlation -> |distance| and sigma -> plane per frame pair
(orientation-consistent subset) -> graph of relative poses -> trajectory -> drift correction.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.geometry import FloatArray
from speckle3d.core.reconstruction import FramePairs
from speckle3d.core.sweep import Sweep
from speckle3d.correction.drift import DriftCorrection, correct_orientation, correct_pose
from speckle3d.motion.coherence import Coherence, estimate_coherence
from speckle3d.motion.decorrelation import fit_curves
from speckle3d.motion.distances import DistanceEstimator, EchoModel, PatchDistances
from speckle3d.motion.inplane import InPlaneMotion, PatchMatch
from speckle3d.motion.intensity import Float32Array
from speckle3d.motion.matching import FrameMatcher, ReadyFrame, compose, inverse
from speckle3d.motion.patches import IntArray
from speckle3d.motion.phantom import phantom_samples
from speckle3d.motion.planes import PairPlane, consistent_subset, fit_plane
from speckle3d.motion.table import CorrelationTable
from speckle3d.motion.trajectory import (
    PairMeasurement,
    PairSchedule,
    SignedPair,
    SignResolver,
    sign_pair,
    solve_trajectory,
)

Progress = Callable[[int, int], None]
"""Called with frames done and frames in all."""
ImageSink = Callable[[int, Float32Array], None]
"""Called with each frame's number and intensity image (vector, sample), in order, off the main thread."""
PairSink = Callable[[FramePairs], None]
"""Called with the pairs of some frames at a time, in order."""


@dataclass
class StageTimes:
    """Seconds spent in each stage; reading and intensity overlap with the rest on another core."""

    seconds: dict[str, float] = field(default_factory=dict)

    def add(self, stage: str, since: float) -> float:
        """Book the time since `since` on `stage`; returns now."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - since
        return now


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


def track(
    sweep: Sweep,
    curves: DecorrelationCurves,
    config: Config | None = None,
    progress: Progress | None = None,
    sink: PairSink | None = None,
    images: ImageSink | None = None,
) -> Tracked:
    """Estimate the pose of every frame from the images, and from the orientation-consistent patches if asked.

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling or patch size.
    InsufficientDataError
        If frames have no speckle in common.
    """
    settings = config or Config()
    if len(sweep) < 2:
        raise InsufficientDataError(f"{sweep.name}: expected at least 2 frames, got {len(sweep)}")
    matcher = FrameMatcher(sweep, settings.intensity, settings.patches, settings.inplane)
    curves.key.require_same(matcher.key)
    walk = _Walk(sweep, matcher, DistanceEstimator(curves, matcher.patches), settings)
    for frame, ready in enumerate(_prefetch(sweep, matcher, walk.times, images)):
        walk.advance(frame, ready)
        if progress:
            progress(frame + 1, len(sweep))
    return _Solution(walk, curves).solve(sink)


def calibrate_curves(
    sweeps: Sequence[Sweep], config: Config | None = None, progress: Progress | None = None
) -> DecorrelationCurves:
    """Measure decorrelation curves on phantom sweeps whose positions are known.

    Raises
    ------
    InsufficientDataError
        If positions are not known, or the distances do not span the curves.
    MismatchError
        If the sweeps differ in probe, frequency or sampling.
    """
    settings = config or Config()
    if not sweeps:
        raise InsufficientDataError("expected at least one phantom sweep, got none")
    samples, keys = [], []
    total, before = sum(len(sweep) for sweep in sweeps), 0
    for sweep in sweeps:
        matcher = FrameMatcher(sweep, settings.intensity, settings.patches, settings.inplane)
        keys.append(matcher.key)
        keys[0].require_same(matcher.key, "the phantom sweeps do not match each other")
        samples.append(phantom_samples(sweep, matcher, settings.curves, _shifted(progress, before, total)))
        before += len(sweep)
    return fit_curves(keys[0], samples, settings.curves)


def _shifted(progress: Progress | None, before: int, total: int) -> Progress | None:
    return None if progress is None else lambda done, _: progress(before + done, total)


class _Walk:
    """First reading of the sweep: which pairs to match, what they share, where frames roughly lie."""

    def __init__(
        self, sweep: Sweep, matcher: FrameMatcher, estimator: DistanceEstimator, config: Config
    ) -> None:
        self.sweep, self.matcher, self.estimator, self.config = sweep, matcher, estimator, config
        self.times = StageTimes()
        self.table = CorrelationTable(len(matcher.patches))
        self.position_mm = np.zeros(len(sweep))
        self.unreliable: list[int] = []
        self._schedule = PairSchedule(config.trajectory)
        self._signs = SignResolver()
        self._ready: dict[int, ReadyFrame] = {}
        self._motion: dict[int, InPlaneMotion] = {0: InPlaneMotion()}

    def advance(self, frame: int, ready: ReadyFrame) -> None:
        """Match a frame with its references, place it, and let go of what is no longer needed."""
        self._ready[frame] = ready
        matches = {first: self._match(first, frame) for first in self._schedule.references(frame)}
        correlations = {first: _median(match.correlation) for first, match in matches.items()}
        if frame:
            self._place(frame, matches, correlations)
        self._schedule.settle(frame, correlations)
        keep = self._schedule.needed(frame)
        self._signs.forget(keep)
        self._ready = {k: v for k, v in self._ready.items() if k in keep}
        self._motion = {k: v for k, v in self._motion.items() if k in keep}

    def _match(self, first: int, second: int) -> PatchMatch:
        then = time.perf_counter()
        fixed, moving = self._ready[first], self._ready[second]
        if second not in self._motion:
            self._motion[second] = compose(self._motion[first], self.matcher.search(fixed, moving))
        start = compose(inverse(self._motion[first]), self._motion[second])
        match = self.matcher.match(fixed, moving, start)
        if second - first == 1:
            self._motion[second] = compose(self._motion[first], match.motion)
        self.times.add("in-plane motion and correlation", then)
        return match

    def _place(self, frame: int, matches: dict[int, PatchMatch], correlations: dict[int, float]) -> None:
        then = time.perf_counter()
        least = self.config.trajectory.least_correlation
        near = [first for first, rho in correlations.items() if rho >= least]
        if not near:
            near = [max(correlations, key=lambda first: correlations[first])]
            self.unreliable.append(frame)
        pairs = []
        for first in near:
            distances = self.estimator.distances(matches[first].correlation)
            plane = fit_plane(distances, self.estimator, self.matcher.at_mm, self.config.planes)
            if plane is not None:
                pairs.append(PairMeasurement(first, frame, matches[first].motion, plane, correlations[first]))
        if not pairs:
            raise InsufficientDataError(
                f"{self.sweep.name}: frame {frame}: expected speckle in common with frame {frame - 1}, "
                "found none"
            )
        self._signs.place(pairs)
        self.position_mm[frame] = self._signs.position(frame)
        for first, match in sorted(matches.items()):
            self.table.append(first, frame, match)
        self.times.add("distances and planes", then)


class _Solution:
    """Second reading, of the correlations alone: distances, planes, trajectories."""

    def __init__(self, walk: _Walk, curves: DecorrelationCurves) -> None:
        self._walk, self._config = walk, walk.config
        self._estimator, self._matcher = walk.estimator, walk.matcher
        self._sensed = sensed_orientation(walk.sweep, walk.config)
        self._coherence: Coherence | None = None
        self._position = walk.position_mm
        self._counted = self._rejected = 0
        table, settings = walk.table, walk.config.coherence
        if settings.adapt:
            then = time.perf_counter()
            self._coherence, self._position = estimate_coherence(
                table.first,
                table.second,
                table.correlation,
                self._position,
                curves,
                self._matcher.patches,
                settings,
            )
            walk.times.add("coherence", then)

    def solve(self, sink: PairSink | None) -> Tracked:
        """Trajectories from all usable pairs."""
        walk, frames = self._walk, len(self._walk.sweep)
        then = time.perf_counter()
        chosen = self._choose()
        models = self._models(chosen)
        measured = [self._measure(row, model) for row, model in zip(chosen, models, strict=True)]
        then = walk.times.add("distances and planes", then)
        centre = self._matcher.centre_mm
        joined = [m for m in measured if m.plane is not None]
        image = solve_trajectory(
            [self._signed(m, m.plane) for m in joined], frames, centre, self._config.trajectory
        )
        subset = None
        if self._sensed is not None:
            pairs = [self._signed(m, m.subset or m.plane) for m in joined]
            subset = solve_trajectory(pairs, frames, centre, self._config.trajectory)
        direction, source = settle_direction(walk.sweep, image, self._config)
        if direction < 0:
            image, subset = mirrored(image), mirrored(subset) if subset is not None else None
        if sink:
            sink(self._rows(joined, direction))
        walk.times.add("trajectory", then)
        return Tracked(
            image,
            subset,
            self._rejected / self._counted if self._counted else float("nan"),
            tuple(walk.unreliable),
            len(joined),
            direction,
            source,
            self._coherence,
            walk.times,
        )

    def _choose(self) -> IntArray:
        """Pairs near enough to tell a distance: what would be left of fully developed speckle is enough."""
        table, least = self._walk.table, self._config.trajectory.least_correlation
        distance = np.abs(self._position[table.second] - self._position[table.first])
        left = np.array([np.median(self._estimator.fully_developed(d)) for d in distance])
        near = left >= least
        # Every frame keeps its nearest pair, however little it tells.
        for frame in np.setdiff1d(np.arange(1, len(self._position)), table.second[near]):
            rows = np.flatnonzero(table.second == frame)
            near[rows[np.argmax(left[rows])]] = True
        return np.flatnonzero(near)

    def _models(self, chosen: IntArray) -> Iterator[EchoModel | None]:
        if self._coherence is None:
            yield from (None for _ in chosen)
            return
        table = self._walk.table
        first, second = table.first[chosen], table.second[chosen]
        shares, gains = self._coherence.at((first + second) / 2)
        distance = np.abs(self._position[second] - self._position[first])
        left = np.exp(-distance / self._coherence.structure_mm)
        for share, gain, h in zip(shares, gains, left, strict=True):
            yield EchoModel(share * h, 1 - share, gain)

    def _measure(self, row: int, model: EchoModel | None) -> _Measured:
        table, at, settings = self._walk.table, self._matcher.at_mm, self._config.planes
        first, second = int(table.first[row]), int(table.second[row])
        distances = self._estimator.distances(table.correlation[row].astype(float), model)
        plane = fit_plane(distances, self._estimator, at, settings, model=model)
        subset = None
        if self._sensed is not None and plane is not None:
            relative = (self._sensed[first].inv() * self._sensed[second]).as_matrix()
            support = consistent_subset(distances, at, relative[2, :2], settings)
            subset = fit_plane(distances, self._estimator, at, settings, support, model)
            known = np.isfinite(distances.distance_mm)
            self._counted += int(known.sum())
            self._rejected += int((known & ~support).sum())
        return _Measured(row, distances, plane, subset)

    def _signed(self, measured: _Measured, plane: PairPlane | None) -> SignedPair:
        assert plane is not None
        table = self._walk.table
        first, second = int(table.first[measured.row]), int(table.second[measured.row])
        sign = 1.0 if self._position[second] >= self._position[first] else -1.0
        pair = PairMeasurement(first, second, table.motion(measured.row), plane, 1.0)
        return sign_pair(pair, plane, sign)

    def _rows(self, measured: list[_Measured], direction: int) -> FramePairs:
        """Rows for the reconstruction file."""
        signed = [self._signed(m, m.plane) for m in measured]
        centre = RigidTransform.from_translation(self._matcher.centre_mm)
        poses = RigidTransform.concatenate([centre * s.pose * centre.inv() for s in signed])
        turn = np.diag([1.0, 1.0, direction, direction, direction, 1.0])
        return FramePairs(
            first=np.array([s.first for s in signed]),
            second=np.array([s.second for s in signed]),
            first_from_second=(mirrored(poses) if direction < 0 else poses).as_matrix(),
            covariance=np.array([turn @ s.covariance @ turn for s in signed]),
            distance_mm=np.array([m.distances.distance_mm for m in measured], dtype=np.float32),
            sigma_mm=np.array([m.distances.sigma_mm for m in measured], dtype=np.float32),
            used=np.array([(m.subset or m.plane).used for m in measured]),  # type: ignore[union-attr]
            patch_centre_mm=self._matcher.patches.centre_mm,
        )


@dataclass(frozen=True)
class _Measured:
    """One pair of the second reading."""

    row: int
    distances: PatchDistances
    plane: PairPlane | None
    subset: PairPlane | None


def _median(correlation: FloatArray) -> float:
    known = correlation[np.isfinite(correlation)]
    return float(np.median(known)) if known.size else 0.0


def correct(
    tracked: Tracked, sweep: Sweep, modes: Sequence[str], config: Config | None = None
) -> dict[str, DriftCorrection]:
    """Correct the drift of the image-based poses in each of `modes`.

    Raises
    ------
    InsufficientDataError
        If a mode's sensor is missing, not calibrated to the image, or covers too little of the sweep.
    """
    settings = config or Config()
    done: dict[str, DriftCorrection] = {}
    for mode in modes:
        if mode == "pose":
            done[mode] = _correct_by_tracker(tracked.image, sweep, settings)
        elif mode == "orientation":
            start = tracked.subset if tracked.subset is not None else tracked.image
            done[mode] = _correct_by_orientation(start, sweep, settings)
        else:
            raise InvalidInputError(f"expected a drift mode among orientation, pose; got {mode!r}")
    return done


def _correct_by_tracker(poses: RigidTransform, sweep: Sweep, config: Config) -> DriftCorrection:
    if sweep.tracker is None:
        raise InsufficientDataError(
            f"{sweep.name}: drift mode pose: expected a tracker in /tracker, got none"
        )
    covered = sweep.tracker.covers(sweep.frame_time_s)
    if not covered.any():
        raise InsufficientDataError(f"{sweep.name}: drift mode pose: no tracker reading covers any frame")
    measured = sweep.tracker.world_from_image(sweep.frame_time_s[covered])
    return correct_pose(poses, measured, covered, sweep.grid.corners_mm, config.drift)


def _correct_by_orientation(poses: RigidTransform, sweep: Sweep, config: Config) -> DriftCorrection:
    if sweep.orientation is None and sweep.tracker is None:
        raise InsufficientDataError(
            f"{sweep.name}: drift mode orientation: expected an orientation sensor in /orientation, got none"
        )
    sensor = sweep.orientation or sweep.tracker
    assert sensor is not None
    covered = sensor.covers(sweep.frame_time_s)
    if not covered.any():
        raise InsufficientDataError(
            f"{sweep.name}: drift mode orientation: no orientation reading covers any frame"
        )
    measured = sensor.world_from_image(sweep.frame_time_s[covered])
    rotation = measured.rotation if isinstance(measured, RigidTransform) else measured
    return correct_orientation(poses, rotation, covered, sweep.grid.centre_mm, config.drift)


def sensed_orientation(sweep: Sweep, config: Config) -> Rotation | None:
    """Smoothed orientation of every frame for the consistent subset; None if off or not known throughout."""
    sensor = sweep.orientation
    if not config.sensors.consistent_subset or sensor is None or sensor.sensor_from_image is None:
        return None
    if not sensor.covers(sweep.frame_time_s).all():
        return None
    return smooth_rotations(
        sensor.world_from_image(sweep.frame_time_s), sweep.frame_time_s, config.sensors.smooth_s
    )


def smooth_rotations(rotations: Rotation, time_s: FloatArray, sigma_s: float) -> Rotation:
    """Smooth rotations that stay within a half turn of their mean, by a Gaussian over time."""
    if sigma_s == 0 or len(rotations) < 3:
        return rotations
    mean = rotations.mean()
    vectors = (mean.inv() * rotations).as_rotvec()
    sigma = sigma_s / float(np.median(np.diff(time_s)))
    return mean * Rotation.from_rotvec(gaussian_filter1d(vectors, sigma, axis=0, mode="nearest"))


def mirrored(world_from_image: RigidTransform) -> RigidTransform:
    """The same motion seen in a mirror in the image plane: elevation, tilt and yaw change sign."""
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    return RigidTransform.from_matrix(flip @ world_from_image.as_matrix() @ flip)


def settle_direction(sweep: Sweep, image: RigidTransform, config: Config) -> tuple[int, str]:
    """Sign of the elevational motion, which images alone cannot tell, and what told it."""
    if config.sensors.direction:
        return config.sensors.direction, "setting"
    centre = sweep.grid.centre_mm
    if sweep.tracker is not None and sweep.tracker.sensor_from_image is not None:
        covered = np.flatnonzero(sweep.tracker.covers(sweep.frame_time_s))
        if covered.size > 1:
            measured = sweep.tracker.world_from_image(sweep.frame_time_s[covered])
            agreement = float(np.sum(_travel(measured, centre) * _travel(image[covered], centre)))
            return (1 if agreement >= 0 else -1), "tracker"
    if sweep.orientation is not None and sweep.orientation.sensor_from_image is not None:
        turned = _turn_agreement(sweep, image)
        if turned is not None:
            return turned, "orientation sensor"
    return 1, "assumed"


def _travel(world_from_image: RigidTransform, centre_mm: FloatArray) -> FloatArray:
    """Elevational position of the image's centre in the first frame, less its mean."""
    z = (world_from_image[0].inv() * world_from_image).apply(centre_mm)[:, 2]
    return np.asarray(z - z.mean())


def _turn_agreement(sweep: Sweep, image: RigidTransform) -> int | None:
    """Whether image and sensor turn the same way, drift aside; None if they do not turn enough to tell."""
    sensor = sweep.orientation
    assert sensor is not None
    covered = np.flatnonzero(sensor.covers(sweep.frame_time_s))
    if covered.size < 20:
        return None
    measured = sensor.world_from_image(sweep.frame_time_s[covered])
    sensed = (measured[0].inv() * measured).as_rotvec()[:, :2]
    seen = (image.rotation[covered[0]].inv() * image.rotation[covered]).as_rotvec()[:, :2]
    t = np.linspace(-1, 1, covered.size)
    trend = np.vander(t, 3)
    left = [v - trend @ np.linalg.lstsq(trend, v, rcond=None)[0] for v in (sensed, seen)]
    correlation = float(np.sum(left[0] * left[1]) / np.sqrt(np.sum(left[0] ** 2) * np.sum(left[1] ** 2)))
    # Slow turns have some ten independent values in a sweep: 0.5 is about two standard deviations.
    return None if abs(correlation) < 0.5 else int(np.sign(correlation))


def _prefetch(
    sweep: Sweep, matcher: FrameMatcher, times: StageTimes, images: ImageSink | None, ahead: int = 3
) -> Iterator[ReadyFrame]:
    """Frames made ready, a few ahead of their use, on a thread of their own."""

    def make(index: int) -> ReadyFrame:
        then = time.perf_counter()
        frame = sweep.frames[index]
        then = times.add("reading", then)
        intensity = matcher.intensity(frame)
        if images:
            images(index, intensity)
        ready = matcher.prepare(intensity)
        times.add("intensity", then)
        return ready

    with ThreadPoolExecutor(1) as worker:
        waiting: list[Future[ReadyFrame]] = []
        try:
            for index in range(len(sweep)):
                waiting.append(worker.submit(make, index))
                if len(waiting) > ahead:
                    yield waiting.pop(0).result()
            for future in waiting:
                yield future.result()
        finally:
            worker.shutdown(wait=True, cancel_futures=True)
