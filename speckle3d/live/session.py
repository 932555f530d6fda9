"""A live session: messages are recorded, frames placed, poses and volumes sent, each in its own thread.

What is received is recorded before anything else is done with it. Frames that come while earlier ones are
still being matched wait, `MOST_WAITING` of them; of more every other one is left for later: they are in the
recording, and the reconstruction at the end has them.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from speckle3d.config import Config
from speckle3d.core.arrays import AnyArray, Float32Array, FloatArray
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InvalidInputError, Speckle3DError
from speckle3d.core.grid import ImageGrid
from speckle3d.core.threads import on_one_thread
from speckle3d.imaging.voxels.volume import CompoundedVolume
from speckle3d.io.family.sweep_writer import GrowingSweep
from speckle3d.io.hdf5 import make_folder
from speckle3d.io.igtl.link import End
from speckle3d.io.igtl.messages import (
    ImageReceived,
    Received,
    TransformReceived,
    packed_image,
    packed_status,
    packed_text,
)
from speckle3d.io.images.headers import RAS_FROM_LPS
from speckle3d.io.import_settings import ImportSettings
from speckle3d.live.checks import GOOD, NO_OVERLAP, TOO_FAST, Advice, words_for
from speckle3d.live.crossing import CrossingCheck
from speckle3d.live.frames import ImageLayout
from speckle3d.live.progress import Devices, Progress
from speckle3d.live.recording import SweepRecorder
from speckle3d.live.tracking import LivePose, LiveTracker
from speckle3d.live.volume import GrowingVolume

VOLUME, ADVICE = "Volume_Reference", "SweepAdvice"
"""Devices: the growing volume in the first image's mm, and words for the person who holds the probe.

Files of this package call a world's axes left, posterior, superior, messages RAS: Slicer shows both alike.
"""
_NOT_READY = 13
"""OpenIGTLink's code of a device that is not ready; 1 says that all is well."""
MOST_BEFORE = 1000
"""Transforms that are kept until the first frame comes."""
MOST_WAITING = 12
"""Frames that wait to be matched, half a second of them: more would be late, not better."""
_LOOK_S = 0.1
VOLUME_EVERY_S = 1.0


@dataclass(frozen=True)
class SessionSettings:
    """Settings of a live session.

    Attributes
    ----------
    recording : path
        New sweep file for everything that is received; its folder is made with the first image.
    image, transform, orientation : str or None
        Devices whose messages count: by default the first image's; no sensor's.
    importing : ImportSettings
        What IMAGE messages do not say.
    config : Config
    volume, check : bool
        Whether to make a growing volume, and to give advice.
    """

    recording: Path
    image: str | None = None
    transform: str | None = None
    orientation: str | None = None
    importing: ImportSettings = field(default_factory=ImportSettings)
    config: Config = field(default_factory=Config)
    volume: bool = True
    check: bool = False


@dataclass(frozen=True)
class _Waiting:
    number: int
    frame: AnyArray
    time_s: float
    sent_s: float
    came_s: float


class Session:
    """Takes messages from a source until it is ended.

    Parameters
    ----------
    source : End
        Where messages come from.
    send : sequence of callable
        Each is given every message to send; none may wait.
    curves : DecorrelationCurves
    settings : SessionSettings
    crossing : CrossingCheck, optional
        Of the first sweep, for advice while the second one is made.

    Attributes
    ----------
    failure : Exception or None
        Why frames could no longer be placed, or volumes made of them: recording went on.
    voxels : CompoundedVolume or None
        The growing volume as it was sent last.
    """

    def __init__(
        self,
        source: End,
        send: Sequence[Callable[[bytes], None]],
        curves: DecorrelationCurves,
        settings: SessionSettings,
        crossing: CrossingCheck | None = None,
    ) -> None:
        self._source, self._outlets, self._curves, self._settings = source, send, curves, settings
        self._crossing = crossing
        self.progress = Progress(words=GOOD if settings.check else "")
        self.poses: list[LivePose] = []
        self.tracker: LiveTracker | None = None
        self.voxels: CompoundedVolume | None = None
        self._volume: GrowingVolume | None = None
        self._centre_mm = np.zeros(3)
        self._queue: deque[_Waiting] = deque()
        self._changed = threading.Condition()
        self._over = threading.Event()
        self.failure: Exception | None = None
        self._devices = Devices(settings.image, settings.transform, settings.orientation)
        self._words, self._sent_s = Advice(), 0.0

    def end(self) -> None:
        """Ask `run` to end."""
        self._over.set()

    def picture(self) -> tuple[Float32Array, ImageGrid] | None:
        """Grey levels of the latest frame, shape (vector, sample), and where they lie; None without one."""
        volume = self._volume
        if volume is None or (levels := volume.latest()) is None:
            return None
        return levels, volume.grid

    def path(self) -> tuple[FloatArray, FloatArray, RigidTransform]:
        """Times of frames, elevation of the image's centre there, mm, and poses, as they are known now."""
        times = np.array([pose.time_s for pose in self.poses])
        poses = RigidTransform.identity(0) if self.tracker is None else self.tracker.poses
        count = min(len(times), len(poses))
        return times[:count], poses[:count].apply(self._centre_mm)[:, 2], poses[:count]

    def run(self, duration_s: float | None = None, show: Callable[[Progress], None] | None = None) -> None:
        """Take messages until ended, for so long at most.

        Parameters
        ----------
        show : callable, optional
            Called several times a second.

        Raises
        ------
        Speckle3DError
            If the recording cannot be written, or images or curves do not fit. What was recorded until then
            can be read. What goes wrong while frames are placed is no reason to end: see `failure`.
        """
        if duration_s is not None and duration_s <= 0.0:
            raise InvalidInputError(f"duration_s: expected seconds above zero, got {duration_s:g}")
        until_s = None if duration_s is None else time.monotonic() + duration_s
        # Readings from before the first frame are kept: that frame lies between two of them.
        waiting: deque[Received] = deque()
        layout = first = None
        while layout is None and not self._is_over(until_s):
            for message in self._source.receive(_LOOK_S):
                self._devices.hear(message)
                if (
                    layout is None
                    and isinstance(message, ImageReceived)
                    and self._settings.image in (None, message.device)
                ):
                    layout, first = ImageLayout.of(message, self._settings.importing, message.device), message
                if layout is not None or isinstance(message, TransformReceived):
                    waiting.append(message)
                if layout is None and len(waiting) > MOST_BEFORE:
                    waiting.popleft()
            self._report(show)
        if layout is None or first is None:
            return
        path, example = self._settings.recording, layout.example
        with self._tracking(layout):
            make_folder(path.parent)
            with GrowingSweep(
                path, example.grid, example.signal, example.frames.dtype, probe=example.probe
            ) as sweep:
                recording = SweepRecorder(sweep, first.time_s, self.progress)
                self._take_all(waiting, recording, layout)
                while not self._is_over(until_s):
                    self._take_all(self._source.receive(_LOOK_S), recording, layout)
                    self._report(show)
                # What has come and waits for the disk is part of the sweep, too.
                self._take_all(self._source.receive(0.0), recording, layout)

    def _is_over(self, until_s: float | None) -> bool:
        late = until_s is not None and time.monotonic() >= until_s
        return self._over.is_set() or late

    def _report(self, show: Callable[[Progress], None] | None) -> None:
        self.progress.missing = self._devices.missing
        if show:
            show(self.progress)

    def _take_all(self, messages: Sequence[Received], recording: SweepRecorder, layout: ImageLayout) -> None:
        """Record messages, and have frames matched."""
        for message in messages:
            self._devices.hear(message)
            if isinstance(message, ImageReceived) and message.device == layout.device:
                self._take_image(message, recording, layout)
            elif isinstance(message, TransformReceived):
                if message.device == self._settings.transform:
                    recording.keep_reading(message, with_position=True)
                elif message.device == self._settings.orientation:
                    recording.keep_reading(message, with_position=False)

    def _take_image(self, image: ImageReceived, recording: SweepRecorder, layout: ImageLayout) -> None:
        came_s = time.monotonic()
        try:
            frame = layout.frame(image)
        except InvalidInputError as error:
            recording.refuse(error)
            return
        time_s = recording.keep_frame(frame, image.time_s)
        if time_s is None:
            return
        with self._changed:
            self._queue.append(_Waiting(self.progress.frames, frame, time_s, image.time_s, came_s))
            if len(self._queue) > MOST_WAITING:
                # Every other one, so that those that are left out leave no gap that speckle does not cross.
                count = len(self._queue)
                self._queue = deque(list(self._queue)[::-2][::-1])
                self.progress.left += count - len(self._queue)
            self._changed.notify()

    @contextmanager
    def _tracking(self, layout: ImageLayout) -> Iterator[None]:
        """Match frames and make volumes in threads that end with the block."""
        self._centre_mm = layout.example.grid.centre_mm
        with closing(LiveTracker(layout.example, self._curves, self._settings.config)) as tracker:
            volume = GrowingVolume(tracker.image_grid)
            self.tracker, self._volume, tracker.images = tracker, volume, volume.keep
            work = {"placing": partial(self._match, tracker, layout)}
            if self._settings.volume:
                work["volumes"] = partial(self._send_volumes, tracker, volume)
            if self._crossing is not None:
                work["crossing check"] = partial(self._crossing.keep_looking, tracker, volume, self._over)
            threads = [threading.Thread(target=self._do, args=task, daemon=True) for task in work.items()]
            for thread in threads:
                thread.start()
            try:
                yield
            finally:
                self._over.set()
                with self._changed:
                    self._changed.notify_all()
                for thread in threads:
                    thread.join()

    def _do(self, name: str, work: Callable[[], None]) -> None:
        """Do work of a thread; an error ends this work alone, since what is received must be recorded."""
        try:
            work()
        except Exception as error:  # noqa: BLE001 (told in the line, and kept for who runs the session)
            self.failure = error
            reason = str(error) if isinstance(error, Speckle3DError) else repr(error)
            self.progress.failure = f"{name} ended, recording goes on: {reason}"

    def _match(self, tracker: LiveTracker, layout: ImageLayout) -> None:
        """Place frames as they come, and send their poses."""
        before = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._over.is_set() or bool(self._queue))
                if not self._queue:
                    return
                waiting = self._queue.popleft()
            tracker.hurry = bool(self._queue)
            pose = tracker.append(waiting.frame, waiting.time_s)
            self._send(layout.pose_message(pose.world_from_image, waiting.sent_s))
            self.poses.append(pose)
            self._sent_s = waiting.sent_s
            self.progress.poses += 1
            self.progress.delay_s = time.monotonic() - waiting.came_s
            self.progress.length_sigma = tracker.length_sigma
            first, last = (end.world_from_image.apply(self._centre_mm)[2] for end in (self.poses[0], pose))
            self.progress.length_mm = float(last - first)
            if self._settings.check:
                self._advise(pose, waiting.sent_s, waiting.number - before > 1)
            before = waiting.number

    def _advise(self, pose: LivePose, sent_s: float, after_gap: bool) -> None:
        words = words_for(pose, self._settings.config.trajectory)
        if after_gap and words in (TOO_FAST, NO_OVERLAP):
            # Frames between were left for later: the gap is none of the person's.
            return
        if words == GOOD and self._crossing is not None:
            words = self._crossing.words
        if self._words.take(words, pose.time_s):
            self.progress.words = text = self._words.text
            self._send(packed_text(ADVICE, sent_s, text))
            self._send(packed_status(ADVICE, sent_s, text, 1 if text == GOOD else _NOT_READY))

    def _send_volumes(self, tracker: LiveTracker, volume: GrowingVolume) -> None:
        """Send the volume about once a second."""
        frames = 1
        while not self._over.wait(VOLUME_EVERY_S):
            poses = tracker.poses
            if len(poses) > frames:
                frames = len(poses)
                with on_one_thread():
                    self.voxels = voxels = volume.compound(poses)
                    place = RAS_FROM_LPS @ voxels.world_from_index
                    self._send(packed_image(VOLUME, self._sent_s, voxels.voxels, place))
                self.progress.volumes += 1

    def _send(self, message: bytes) -> None:
        for send in self._outlets:
            send(message)
