"""Words for the person who holds the probe."""

from types import SimpleNamespace

import numpy as np
import pytest

from speckle3d.live.checks import GOOD, NO_CONTACT, NO_OVERLAP, SEEN_S, STAYS_S, TOO_FAST, Advice, words_for
from speckle3d.matching.quality import FrameFlag
from speckle3d.matching.schedule import TrajectorySettings

SETTINGS = TrajectorySettings()


@pytest.mark.parametrize(
    ("flags", "median", "words"),
    [
        (0, 0.9, GOOD),
        (0, np.nan, GOOD),
        (0, SETTINGS.clear_correlation - 0.01, TOO_FAST),
        (FrameFlag.UNMATCHED, 0.1, NO_OVERLAP),
        (FrameFlag.LIFTED | FrameFlag.UNMATCHED, 0.0, NO_CONTACT),
        (FrameFlag.SATURATED, 0.9, "gain too high"),
    ],
)
def test_a_frame_is_told_by_what_the_reconstruction_asks_of_it(flags, median, words):
    assert words_for(SimpleNamespace(flags=int(flags), median=median), SETTINGS) == words


def test_words_come_when_they_are_so_for_a_while_and_stay_to_be_read():
    words, changes = Advice(), []
    for k in range(100):
        # One frame too fast, then two seconds of it, then good.
        latest = TOO_FAST if k == 5 or 20 <= k < 70 else GOOD
        if words.take(latest, k / 25):
            changes.append((words.text, k / 25))
    assert [text for text, _ in changes] == [TOO_FAST, GOOD]
    assert changes[0][1] == pytest.approx(20 / 25 + SEEN_S, abs=0.05)
    assert changes[1][1] >= changes[0][1] + STAYS_S
