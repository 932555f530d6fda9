"""Advice to the person who holds the probe, by the checks that the reconstruction uses."""

from dataclasses import dataclass

from speckle3d.live.tracking import LivePose
from speckle3d.matching.quality import FrameFlag
from speckle3d.matching.schedule import TrajectorySettings

GOOD = "good"
TOO_FAST, NO_OVERLAP, NO_CONTACT = "too fast", "not overlapping: go back to where it was", "lifted"
_OF_FLAGS = {
    FrameFlag.LIFTED: NO_CONTACT,
    FrameFlag.SATURATED: "gain too high",
    FrameFlag.NO_SPECKLE: "no speckle",
    FrameFlag.FROZEN: "image frozen",
}
"""In the order in which they are looked for."""
SEEN_S, STAYS_S = 0.25, 1.0
"""How long something must be so before it is said, and how long what was said stays: to be read."""


def words_for(pose: LivePose, settings: TrajectorySettings) -> str:
    """Advice by one frame.

    A frame is like none before where no median correlation reaches `least_correlation`, below which the
    reconstruction uses no pair; it came too fast where it is less like the last one than `clear_correlation`.
    """
    for flag, words in _OF_FLAGS.items():
        if pose.flags & flag:
            return words
    if pose.flags & FrameFlag.UNMATCHED:
        return NO_OVERLAP
    # False for the first frame, which has no correlation.
    if pose.median < settings.clear_correlation:
        return TOO_FAST
    return GOOD


@dataclass
class Advice:
    """Advice with a minimum display time.

    Attributes
    ----------
    text : str
    """

    text: str = GOOD
    _next: str = GOOD
    _since_s: float = float("-inf")
    _text_s: float = float("-inf")

    def take(self, words: str, time_s: float) -> bool:
        """Update the advice at a time; true if the displayed text changes."""
        if words != self._next:
            self._next, self._since_s = words, time_s
        lasts = time_s - self._since_s >= SEEN_S and time_s - self._text_s >= STAYS_S
        if self._next == self.text or not lasts:
            return False
        self.text, self._text_s = self._next, time_s
        return True
