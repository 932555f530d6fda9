"""Check while a second sweep is made that it crosses the first one."""

import threading

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Sweep
from speckle3d.core.threads import on_one_thread
from speckle3d.correction.crossing.pair import crossing_so_far
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.correction.crossing.sweep import CrossingSweep
from speckle3d.crossing_sweeps import crossing_side, stack_for
from speckle3d.live.checks import GOOD
from speckle3d.live.tracking import LiveTracker
from speckle3d.live.volume import GrowingVolume
from speckle3d.tracking import track

NOT_YET = "not overlapping with the first sweep yet: go on"
NO_PLACE = "not overlapping with the first sweep"
TURN_MORE = "turn more about the beam"
LEAST_FRAMES = 40
SCALE_SIGMA, TURN_SIGMA_PER_MM = 0.03, 1e-3
"""Of a sweep that is still going on: wide, since only its place is asked for."""
PAUSE_S = 5.0
"""Between two looks, each of which takes seconds."""


class CrossingCheck:
    """Compares the frames so far with the first sweep, now and then.

    Parameters
    ----------
    first : Sweep
        The first sweep, which is tracked.
    curves : DecorrelationCurves
    config : Config
    progress : callable, optional

    Attributes
    ----------
    words : str
        What there is to say by the last look, by the limits of the reconstruction; that it is good before the
        first one.

    Raises
    ------
    MismatchError, InsufficientDataError
        As `track`.
    """

    def __init__(
        self, first: Sweep, curves: DecorrelationCurves, config: Config, progress: Progress | None = None
    ) -> None:
        stack = stack_for(first, config)
        motion = track(first, curves, config, progress, images=stack.keep)
        self._first, self._settings = crossing_side(first, motion, stack, config), config.crossing
        self.words = GOOD

    def look(self, tracker: LiveTracker, volume: GrowingVolume) -> None:
        """Lay the frames whose images are kept against the first sweep."""
        numbers, images = volume.images()
        poses, flags = tracker.poses, tracker.flags
        numbers = numbers[numbers < min(len(poses), flags.size)]
        if numbers.size < LEAST_FRAMES:
            return
        stack = ImageStack(tracker.image_grid)
        stack.take(0, images[: numbers.size])
        second = CrossingSweep(
            "this sweep",
            stack,
            poses[numbers],
            self._first.centre_mm,
            SCALE_SIGMA,
            TURN_SIGMA_PER_MM,
            flags=flags[numbers],
        )
        settings = self._settings
        try:
            crossing = crossing_so_far(self._first, second, settings)
        except (MismatchError, InsufficientDataError) as error:
            # Too little of it so far is no reason to complain.
            self.words = NO_PLACE if isinstance(error, MismatchError) else GOOD
            return
        faults = {
            NO_PLACE: crossing.similarity < settings.least_similarity,
            TURN_MORE: crossing.angle_deg < settings.least_angle_deg,
            NOT_YET: crossing.overlap_mm < settings.least_overlap_mm,
        }
        self.words = next((words for words, applies in faults.items() if applies), GOOD)

    def keep_looking(self, tracker: LiveTracker, volume: GrowingVolume, over: threading.Event) -> None:
        """Look again and again, on this thread alone, until it is over."""
        with on_one_thread():
            while not over.wait(PAUSE_S):
                self.look(tracker, volume)
