"""Record received images and transforms into a sweep file, on one clock."""

import time

from speckle3d.core.arrays import AnyArray
from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import transforms_from_matrices
from speckle3d.io.family.sweep_writer import GrowingSweep
from speckle3d.io.igtl.messages import TransformReceived
from speckle3d.live.progress import Progress

RESTARTED_S = 1.0
"""A frame so long before the last one shows that the sender was started anew."""


class SweepRecorder:
    """Images and transforms written into a growing sweep file as they are received.

    Times are the sender's, counted from the first frame's. If its clock begins anew, they go on by what has
    passed here; so they do if messages have no time, which OpenIGTLink writes as zero.

    Parameters
    ----------
    sweep : GrowingSweep
    first_s : float
        The first frame's time on the sender's clock.
    progress : Progress
        Told how many frames are written, what is refused, and how often the sender's clock begins anew.
    """

    def __init__(self, sweep: GrowingSweep, first_s: float, progress: Progress) -> None:
        self._sweep, self._progress = sweep, progress
        self._first_s, self._last_s = first_s, float("-inf")
        self._began_s = self._came_s = time.monotonic()
        self._timeless = False

    def keep_frame(self, frame: AnyArray, sent_s: float) -> float | None:
        """Write a frame; its time in the sweep, or None if it is not later than the last frame's."""
        now_s = time.monotonic()
        if self._progress.frames and sent_s == 0.0:
            self._timeless = True
        elif sent_s - self._first_s < self._last_s - RESTARTED_S:
            self._first_s = sent_s - (self._last_s + now_s - self._came_s)
            self._progress.restarts += 1
        time_s = self._time_of(sent_s, now_s)
        try:
            if time_s <= self._last_s:
                back_s = self._last_s - time_s
                raise InvalidInputError(
                    f"IMAGE: expected a later time than the last, got {back_s:g} s before"
                )
            self._sweep.append(frame, time_s)
        except InvalidInputError as error:
            self.refuse(error)
            return None
        self._progress.frames += 1
        self._last_s, self._came_s = time_s, now_s
        return time_s

    def keep_reading(self, transform: TransformReceived, with_position: bool) -> None:
        """Write a sensor's reading: of a tracker, or with the rotation alone of an orientation sensor."""
        time_s = self._time_of(transform.time_s, time.monotonic())
        where = f"TRANSFORM {transform.device}"
        try:
            # Rigid to single precision as it comes.
            rigid = transforms_from_matrices(transform.matrix[None], where)
            if with_position:
                name, reading = "tracker", rigid.as_matrix()[0]
            else:
                name, reading = "orientation", rigid.rotation.as_quat(scalar_first=True)[0]
            if transform.valid:
                self._sweep.append_reading(name, time_s, reading)
        except InvalidInputError as error:
            self.refuse(error)

    def _time_of(self, sent_s: float, now_s: float) -> float:
        return now_s - self._began_s if self._timeless else sent_s - self._first_s

    def refuse(self, error: InvalidInputError) -> None:
        """Count a message that cannot be written."""
        self._progress.refusals += 1
        self._progress.last_refusal = str(error)
