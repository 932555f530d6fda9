"""Check while a second sweep is made that it crosses the first one."""

from __future__ import annotations

import threading

from speckle3d.config import Config
from speckle3d.core.curves import DecorrelationCurves
from speckle3d.core.errors import InsufficientDataError, MismatchError
from speckle3d.core.progress import Progress
from speckle3d.core.sweep import Sweep
from speckle3d.core.threads import on_one_thread
from speckle3d.correction.crossing.pair import CrossingSoFar, crossing_so_far
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.correction.crossing.sweep import CrossingSettings, CrossingSweep
from speckle3d.crossing_sweeps import crossing_side, stack_for
from speckle3d.live.checks import GOOD
from speckle3d.live.tracking import LiveTracker
from speckle3d.live.volume import GrowingVolume
from speckle3d.pipeline import track

NOT_YET = "not overlapping with the first sweep yet: go on"
NO_PLACE = "not overlapping with the first sweep"
TURN_MORE = "turn more about the beam"
LEAST_FRAMES = 40
SCALE_SIGMA, TURN_SIGMA_PER_MM = 0.03, 1e-3
"""Of a sweep that is still going on: wide, since only its place is asked for."""
PAUSE_S = 5.0
"""Between two looks, each of which takes seconds."""


def words_of(crossing: CrossingSoFar, settings: CrossingSettings) -> str:
    """Advice on two crossing sweeps, by the limits of the reconstruction."""
    if crossing.similarity < settings.least_similarity:
        return NO_PLACE
    if crossing.angle_deg < settings.least_angle_deg:
        return TURN_MORE
    if crossing.overlap_mm < settings.least_overlap_mm:
        return NOT_YET
    return GOOD


class CrossingCheck:
    """Compares the frames so far with the first sweep, now and then.

    Parameters
    ----------
    first : CrossingSweep
        The first sweep.
    settings : CrossingSettings

    Attributes
    ----------
    words : str
        What there is to say by the last look; that it is good before the first one.
    """

    def __init__(self, first: CrossingSweep, settings: CrossingSettings) -> None:
        self._first, self._settings = first, settings
        self.words = GOOD

    @classmethod
    def of(
        cls, first: Sweep, curves: DecorrelationCurves, config: Config, progress: Progress | None = None
    ) -> CrossingCheck:
        """Track the first sweep.

        Raises
        ------
        MismatchError, InsufficientDataError
            As `track`.
        """
        stack = stack_for(first, config)
        motion = track(first, curves, config, progress, images=stack.keep)
        return cls(crossing_side(first, motion, stack, config), config.crossing)

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
        try:
            self.words = words_of(crossing_so_far(self._first, second, self._settings), self._settings)
        except MismatchError:
            self.words = NO_PLACE
        except InsufficientDataError:
            # Too little of it so far.
            self.words = GOOD

    def keep_looking(self, tracker: LiveTracker, volume: GrowingVolume, over: threading.Event) -> None:
        """Look again and again, on this thread alone, until it is over."""
        with on_one_thread():
            while not over.wait(PAUSE_S):
                self.look(tracker, volume)
