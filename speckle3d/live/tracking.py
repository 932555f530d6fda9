"""Track a sweep as it is made: match and place each frame, and revise earlier poses.

A frame is matched by the functions that match recordings, in one block however long the sweep becomes, and
placed by its planes against the frames it was matched with. Meanwhile, in another thread, the motion of the
latest frames is estimated anew from their rows of the table by the function that serves recordings; its poses
take the place of earlier ones.

Two things of a recording's reconstruction have to wait for its end: ties between visits of the same tissue,
and the sign of the motion, which sensors tell.
"""

import threading
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import AnyArray, FloatArray, IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import mirrored
from speckle3d.core.poses import RelativePoses
from speckle3d.core.sweep import BModeSettings, Sweep
from speckle3d.core.threads import on_one_thread
from speckle3d.matching.frames import FrameByFrame, ImageSink
from speckle3d.matching.intensity import Echo
from speckle3d.matching.matcher import FrameMatcher
from speckle3d.matching.quality import FrameFeatures, FrameFlag, flag_frames, short_repeats
from speckle3d.matching.schedule import PairSchedule
from speckle3d.matching.table import CorrelationTable
from speckle3d.matching.texture import FRAMES, Texture
from speckle3d.motion.estimate import Motion, alike_pairs, elevation_of, estimate_motion, strangers
from speckle3d.motion.planes import MotionProblem, pair_planes
from speckle3d.motion.signs import likeliest_path, on_path
from speckle3d.motion.tissue import structure_openness
from speckle3d.motion.trajectory import edges_of, solve_trajectory

ANEW = 4
"""Frames up to which everything is estimated anew with each."""
LATEST = 150
"""Frames whose motion is estimated anew while a sweep is longer, some ten millimetres; the first third
stay."""
BEFORE = 10
"""Frames just before the latest that tell which way the probe goes."""
EVERY = 8
"""Frames after which motion is estimated anew, if nothing is done in the background."""
LONGEST_HURRY_S = 1.0
"""For which nothing is revised, however many frames wait."""
LAST = 10**9
"""Later than any frame."""


@dataclass(frozen=True)
class LivePose:
    """Pose of a frame as estimated on its arrival.

    Attributes
    ----------
    time_s : float
    world_from_image : RigidTransform
        The first frame's is the identity; in mm.
    flags : int
        `FrameFlag`; zero for a frame to be trusted.
    median : float
        Median correlation with the frame before; NaN for the first.
    """

    time_s: float
    world_from_image: RigidTransform
    flags: int
    median: float


class LiveTracker:
    """Match and place frames as they arrive.

    Parameters
    ----------
    example : Sweep
        Of the same images; none of its frames is read.
    curves : DecorrelationCurves
        Of the sweep's probe and settings.
    config : Config, optional
    background : bool
        Revise in a thread of its own, as fast as it can; false: now and then, with the frame that has come.

    Attributes
    ----------
    image_grid : ImageGrid
        Of the intensity images.
    flags : ndarray of int
        `FrameFlag` of all frames; zero for those to be trusted.
    images : callable or None
        Called with every frame's intensity image, if set before the first frame.
    hurry : bool
        Set while frames wait to be matched: what is revised in the background waits, but not for ever.

    Raises
    ------
    MismatchError
        If the curves belong to another probe, frequency, sampling, patch size or depth.
    """

    def __init__(
        self,
        example: Sweep,
        curves: DecorrelationCurves,
        config: Config | None = None,
        background: bool = True,
    ) -> None:
        self.images: ImageSink | None = None
        self._config = c = config or Config()
        matcher = FrameMatcher(example, c, curves)
        self.image_grid = matcher.grid
        self._example, self._matcher = example, matcher
        self._echoes: list[Echo] = []
        self._matching = FrameByFrame(matcher, PairSchedule(self._config.trajectory))
        self._problem = MotionProblem(curves, matcher.patches, matcher.centre_mm, 1, c.planes, c.trajectory)
        self._texture = Texture(matcher)
        self._features: list[FrameFeatures] = []
        self._tables: list[CorrelationTable] = []
        self.flags: IntArray = np.zeros(0, dtype=np.int64)
        self._poses = RigidTransform.identity(0)
        self._motion: Motion | None = None
        self._lock, self._growth = threading.Lock(), threading.Condition()
        self._end = False
        self._failure: Exception | None = None
        self.hurry = False
        self._thread: threading.Thread | None = None
        if background:
            self._thread = threading.Thread(target=self._keep_revising, name="revising", daemon=True)
            self._thread.start()

    def __len__(self) -> int:
        return len(self._tables)

    @property
    def poses(self) -> RigidTransform:
        """Poses of all frames, as they are known now."""
        with self._lock:
            return self._poses

    @property
    def length_sigma(self) -> float:
        """Relative standard deviation of the length so far; NaN before anything is known of it."""
        motion = self._motion
        if motion is None:
            return float("nan")
        # Live, no spectrum tells how much more than the phantom the tissue attenuates.
        curves = motion.problem.curves
        curves_sigma = curves.mismatch(self._config.curves.same_probe)
        # Nor are curves stretched for structure: lengths are up to exp(2 structure) times as long.
        short = 0.0 if curves.of_tissue else np.expm1(2.0 * structure_openness(self._texture))
        return float(np.linalg.norm([motion.coherence.scale_sigma, curves_sigma, short]))

    def close(self) -> None:
        """End the thread that revises."""
        with self._growth:
            self._end = True
            self._growth.notify_all()
        if self._thread is not None:
            self._thread.join()

    def append(self, frame: AnyArray, time_s: float) -> LivePose:
        """Match a frame with earlier ones and place it.

        Parameters
        ----------
        frame : ndarray, shape (vector, sample)
            As recorded.
        time_s : float
            On the image clock, later than the last frame's.
        """
        if self._failure is not None:
            raise self._failure
        number = len(self._tables)
        ready = self._matcher.ready(frame)
        if self.images:
            self.images(number, ready.echo.intensity)
        if number % EVERY == 0 and number < EVERY * FRAMES:
            self._echoes.append(ready.echo)
            self._matcher.leave_out(self._echoes)
            if isinstance(self._example.signal, BModeSettings):
                self._texture.keep(number, ready)
        table = self._matching.advance(number, ready.frame)
        with self._lock:
            self._keep(ready.features, table)
            self._place()
        # Without another thread now and then.
        if len(self) <= ANEW or (self._thread is None and len(self) % EVERY == 0):
            self.revise()
        with self._growth:
            self._growth.notify_all()
        before = table.median[table.first == number - 1]
        with self._lock:
            return LivePose(
                time_s,
                self._poses[number],
                int(self.flags[number]),
                float(before[0]) if before.size else float("nan"),
            )

    def _keep(self, features: FrameFeatures, table: CorrelationTable) -> None:
        """Store a frame's features and pairs, with the pose of the last frame."""
        number = len(self._tables)
        self._features.append(features)
        self._tables.append(table)
        flag = int(flag_frames(self._features[-2:], self._config.quality)[-1])
        least = self._config.trajectory.least_correlation
        if len(table) and table.median.max() < least:
            flag |= FrameFlag.UNMATCHED
        self.flags = np.append(self.flags, flag)
        self._poses = self._poses[[*range(number), number - 1]] if number else RigidTransform.identity(1)

    def _place(self) -> None:
        """Place the latest frame against those it was matched with, if enough is known to do so."""
        motion, number = self._motion, len(self._tables) - 1
        if motion is None or not len(self._tables[number]):
            return
        frames = np.unique([*range(max(0, number - BEFORE), number + 1), *self._tables[number].first])
        table = replace(
            self._tables[number].among(~self._matcher.overlaid),
            first=np.searchsorted(frames, self._tables[number].first),
            second=np.full(len(self._tables[number]), frames.size - 1),
        )
        problem, before = replace(motion.problem, frames=frames.size, repeats=()), self._poses[frames[:-1]]
        rows = alike_pairs(problem, table, table.median)
        models = motion.coherence.models(np.full(rows.size, LAST))
        pairs, has_plane = pair_planes(problem, table, rows, models)
        pairs = pairs[has_plane].scaled(motion.coherence.scale)
        if not len(pairs):
            return
        earlier = elevation_of(before, problem.centre_mm)[:, :2]
        apart = strangers(problem, table)
        pairs = on_path(pairs, likeliest_path(pairs, frames.size, apart, earlier))
        edges = edges_of(table, motion.slopes.applied(pairs))
        # Earlier frames stay: every edge then starts at the first of them.
        centre, start = RigidTransform.from_translation(problem.centre_mm), np.zeros_like(edges.first)
        relative = centre.inv() * before[0].inv() * before[edges.first] * centre * edges.poses
        star = RelativePoses(start, start + 1, relative, edges.covariance)
        solution = solve_trajectory(star, 2, problem.centre_mm, problem.trajectory.huber)
        self._poses = RigidTransform.concatenate([self._poses[:-1], before[0] * solution.poses[-1:]])

    def revise(self, latest: int = LATEST) -> None:
        """Estimate the motion of the latest frames anew; later frames go along with the last of them."""
        with self._lock:
            tables, flags, before = tuple(self._tables), self.flags, self._poses
        count = len(tables)
        begin = max(0, count - latest)
        if count - begin < 2:
            return
        every = CorrelationTable.joined(tables[begin + 1 :])
        table = every.where(every.first >= begin, -begin).among(~self._matcher.overlaid)
        sound = table.joins((flags[begin:] & ~FrameFlag.UNMATCHED) == 0)
        if not sound.any():
            return
        repeats = np.flatnonzero(short_repeats(flags[begin:]))
        problem = replace(self._problem, frames=count - begin, repeats=repeats)
        try:
            motion = estimate_motion(problem, table.where(sound))
        except (InsufficientDataError, np.linalg.LinAlgError):
            # Frames that come later may tell.
            return
        # The first of them stay: what is seen of structure ends there, and what was told of them before
        # holds.
        poses, stay = motion.poses, latest // 3 if begin else 0
        if begin and _against(poses, before[begin:], problem.centre_mm):
            poses = mirrored(poses)
        with self._lock:
            anchor, last = self._poses[begin + stay], self._poses[count - 1]
            poses = anchor * poses[stay].inv() * poses[stay:] if stay else before[begin] * poses
            parts = [self._poses[: begin + stay], poses]
            if count < len(self._poses):
                parts.append(poses[-1] * last.inv() * self._poses[count:])
            self._poses, self._motion = RigidTransform.concatenate(parts), motion

    def _keep_revising(self) -> None:
        """Revise as often as there are new frames, on this thread alone: matching needs the others."""
        try:
            with on_one_thread():
                frames = 0
                while self._wait_for_more(frames):
                    frames = len(self)
                    self.revise()
        except Exception as error:  # noqa: BLE001 (raised with the next frame)
            self._failure = error

    def _wait_for_more(self, frames: int) -> bool:
        """Wait for more frames; false at the end."""
        with self._growth:
            self._growth.wait_for(lambda: self._end or len(self) > max(frames, ANEW))
            self._growth.wait_for(lambda: self._end or not self.hurry, LONGEST_HURRY_S)
            return not self._end


def _against(poses: RigidTransform, before: RigidTransform, centre_mm: FloatArray) -> bool:
    """Whether two trajectories of the same frames go opposite ways along the image's normal."""
    steps = [(path[:-1].inv() * path[1:]).apply(centre_mm)[:, 2] - centre_mm[2] for path in (poses, before)]
    return bool(steps[0] @ steps[1] < 0)
