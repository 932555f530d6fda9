"""A sweep tracked as it is made: each frame matched and placed when it comes, poses revised as more is known.

A frame is matched by the functions that match recordings, in one block however long the sweep becomes, and
placed with the coherence that is known so far. Meanwhile, in another thread, coherence is learnt anew from
the latest frames, and everything from all frames each time the sweep has grown by half: the cost per frame
stays bounded. Poses of a revision take the place of earlier ones.

Two things of a recording's reconstruction have to wait for its end: ties between visits of the same tissue,
and the sign of the motion, which sensors tell.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import IntArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.sweep import Sweep
from speckle3d.core.threads import on_one_thread
from speckle3d.live.placing import OPEN, place_latest
from speckle3d.live.revising import LATEST, Growing, Reviser, Revision
from speckle3d.live.window import FramePlanes, Known
from speckle3d.matching.blocks import FrameByFrame, FrameMaker, ImageSink
from speckle3d.matching.quality import FrameFeatures, FrameFlag, flag_frames
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.planes import PairPlanes
from speckle3d.motion.uncertainty import SlopeEvidence
from speckle3d.stages import matcher_for

ANEW = 4
"""Frames up to which everything is estimated anew with each."""
GROWTH = 1.5
"""Factor of a sweep's length after which everything is estimated anew."""
EVERY = 8
"""Frames after which coherence is learnt anew, if nothing is done in the background."""
LONGEST_HURRY_S = 1.0
"""For which nothing is revised, however many frames wait."""
COMPARED = 400
"""Earlier frames against whose levels a frame's are judged."""


@dataclass(frozen=True)
class LivePose:
    """Where a frame is, as far as is known when it has come.

    Attributes
    ----------
    frame : int
        Counted from zero over the frames that were matched.
    time_s : float
    world_from_image : RigidTransform
        The first frame's is the identity; in mm.
    flags : int
        `FrameFlag`; zero for a frame to be trusted.
    median : float
        Median correlation with the frame before; NaN for the first.
    best : float
        The largest median correlation with any earlier frame.
    revision : int
        How often what is known of the sweep had been revised.
    """

    frame: int
    time_s: float
    world_from_image: RigidTransform
    flags: int
    median: float
    best: float
    revision: int


class LiveTracker:
    """Places frames as they come.

    Parameters
    ----------
    example : Sweep
        Of the same images; none of its frames is read.
    curves : DecorrelationCurves
        Of the sweep's probe and settings.
    config : Config, optional
    background : bool
        Revise in a thread of its own, as fast as it can; false: now and then, with the frame that has come.
    images : callable, optional
        Called with every frame's intensity image.

    Attributes
    ----------
    image_grid : ImageGrid
        Of the intensity images.
    images : callable or None
        As given; may be set before the first frame.
    hurried : bool
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
        images: ImageSink | None = None,
    ) -> None:
        self.images = images
        self._config = config or Config()
        matcher = matcher_for(example, curves, self._config)
        self._patches = len(matcher.patches)
        self.image_grid = matcher.grid
        self._maker = FrameMaker(example.signal, matcher, self._config.quality)
        self._matched = FrameByFrame(matcher, self._config.trajectory)
        self._reviser = Reviser(matcher, curves, self._config)
        self._features: list[FrameFeatures] = []
        self._tables: list[CorrelationTable] = []
        self._planes: list[FramePlanes] = []
        self._flags = np.zeros(0, dtype=np.int64)
        self._poses = RigidTransform.identity(0)
        self._known: Known | None = None
        self._given = Known(self._reviser.reader, None, SlopeEvidence(np.ones(2), np.zeros(2)))
        self._revision, self._last_whole, self._looked_at = 0, 0, 0
        self._lock, self._grown = threading.Lock(), threading.Condition()
        self._ended = False
        self._failure: Exception | None = None
        self.hurried = False
        self._thread: threading.Thread | None = None
        if background:
            self._thread = threading.Thread(target=self._keep_revising, name="revising", daemon=True)
            self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._tables)

    @property
    def poses(self) -> RigidTransform:
        """Poses of all frames, as they are known now."""
        with self._lock:
            return self._poses

    @property
    def flags(self) -> IntArray:
        """`FrameFlag` of all frames; zero for those to be trusted."""
        return self._flags

    def close(self) -> None:
        """End the thread that revises."""
        with self._grown:
            self._ended = True
            self._grown.notify_all()
        if self._thread is not None:
            self._thread.join()

    def append(self, frame: npt.NDArray[Any], time_s: float) -> LivePose:
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
        made = self._maker.make(number, frame)
        if self.images:
            self.images(number, made.intensity)
        pairs = self._matched.advance(number, made.ready)
        table = CorrelationTable.of(((i, number, pairs[i]) for i in sorted(pairs)), self._patches)
        with self._lock:
            self._keep(made.features, table)
            self._place()
        if self._thread is None or len(self) <= ANEW:
            self._revise_now()
        with self._grown:
            self._grown.notify_all()
        best = float(table.median.max(initial=-np.inf))
        before = table.median[table.first == number - 1]
        with self._lock:
            return LivePose(
                number,
                time_s,
                self._poses[number],
                int(self._flags[number]),
                float(before[0]) if before.size else float("nan"),
                best,
                self._revision,
            )

    def revise(self) -> None:
        """Estimate everything anew from all frames, and wait for it."""
        if len(self) > 1:
            self._take(self._reviser.whole(self._growing()))

    def _keep(self, features: FrameFeatures, table: CorrelationTable) -> None:
        """Take a frame's features and pairs; it stands where the last one was."""
        number = len(self._tables)
        self._features.append(features)
        self._tables.append(table)
        flag = int(flag_frames(self._features[-COMPARED:], self._config.quality)[-1])
        least = self._config.trajectory.least_correlation
        if len(table) and table.median.max() < least:
            flag |= FrameFlag.UNMATCHED
        self._flags = np.append(self._flags, flag)
        self._poses = self._poses[[*range(number), number - 1]] if number else RigidTransform.identity(1)
        none = np.zeros(0, dtype=np.int64)
        self._planes.append(FramePlanes(none, none, PairPlanes.none(self._patches)))
        self._planes[: -2 * OPEN] = []

    def _place(self) -> None:
        """Place the latest frame, if enough is known to do so."""
        if self._known is None:
            return
        bad = (self._flags & ~int(FrameFlag.UNMATCHED)) != 0
        placed = place_latest(self._tables, self._planes, bad, self._poses, self._known)
        self._poses = RigidTransform.concatenate([self._poses[: placed.first], placed.poses])
        self._planes[-1] = placed.planes

    def _growing(self) -> Growing:
        with self._lock:
            return Growing(tuple(self._tables), self._flags, self._poses)

    def _revise_now(self) -> None:
        """Revise if it is time to, without help of another thread."""
        frames = len(self)
        if frames <= ANEW or frames % EVERY == 0:
            self._revised(self._growing())

    def _revised(self, sweep: Growing) -> None:
        """Learn what frames tell: all of them, or the latest if all were asked a short while ago."""
        if len(sweep) < 2:
            return
        known = self._known
        try:
            if known is None or len(sweep) <= LATEST or len(sweep) >= GROWTH * self._last_whole:
                revision = self._reviser.whole(sweep)
                self._last_whole = len(sweep)
            else:
                revision = self._reviser.latest(sweep, known)
        except (InsufficientDataError, np.linalg.LinAlgError):
            # Frames that come later may tell.
            return
        self._take(revision)

    def _take(self, revision: Revision) -> None:
        """Put a revision's poses in place of earlier ones; later frames go along with its last."""
        first, stop = revision.first, revision.stop
        with self._lock:
            parts = [self._poses[:first], revision.poses]
            if stop < len(self._poses):
                parts.append(revision.poses[-1] * self._poses[stop - 1].inv() * self._poses[stop:])
            self._poses = RigidTransform.concatenate(parts)
            begin = len(self._tables) - len(self._planes)
            for frame, planes in enumerate(revision.planes, start=first):
                if frame >= begin:
                    self._planes[frame - begin] = planes
            self._known = revision.known
            self._revision += 1

    def _keep_revising(self) -> None:
        """Revise as often as there are new frames, on this thread alone: matching needs the others."""
        try:
            with on_one_thread():
                while self._awaited(self._looked_at):
                    sweep = self._growing()
                    self._revised(sweep)
                    self._looked_at = len(sweep)
        except Exception as error:  # noqa: BLE001 (raised with the next frame)
            self._failure = error

    def _awaited(self, frames: int) -> bool:
        """Wait for more frames; false at the end."""
        with self._grown:
            self._grown.wait_for(lambda: self._ended or len(self) > max(frames, ANEW))
            self._grown.wait_for(lambda: self._ended or not self.hurried, LONGEST_HURRY_S)
            return not self._ended
