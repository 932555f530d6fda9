"""Frames that are no frames: repeats, and a probe lifted for a moment."""

from dataclasses import replace

import numpy as np
import pytest

from speckle3d.matching.quality import FrameFlag
from speckle3d.pipeline import track


class Reordered:
    """Frames of a sweep in another order, a little noise in each."""

    def __init__(self, frames, order, noise=0.0):
        self._frames, self._order, self._noise = frames, order, noise
        self.shape, self.dtype = (len(order), *frames.shape[1:]), frames.dtype

    def __getitem__(self, index):
        frame = self._frames[int(self._order[index])]
        noise = np.random.default_rng(index).normal(0, self._noise * frame.std(), frame.shape)
        return (frame + noise).astype(frame.dtype)


def reordered(sweep, order, noise=0.0):
    return replace(
        sweep,
        frames=Reordered(sweep.frames, order, noise),
        frame_time_s=0.04 * np.arange(len(order)),
        truth=sweep.truth[order],
        tracker=None,
        orientation=None,
    )


def test_a_repeated_frame_is_flagged(sweep, curves):
    order = np.arange(48)
    order[24] = 23
    found = track(reordered(sweep, order), curves)
    assert np.flatnonzero(found.flags & FrameFlag.FROZEN).tolist() == [24]


@pytest.mark.parametrize("lost", [(22, 23), (20, 21, 22, 23), (9, 10, 11), (23, 24, 25)])
def test_the_path_goes_on_past_frames_without_speckle(sweep, curves, lost):
    """Where the next is 0.6 mm on, speckle itself has little left."""

    class Lifted(Reordered):
        def __getitem__(self, index):
            frame = super().__getitem__(index)
            return 0 * frame if index in lost else frame

    spoilt = replace(reordered(sweep, np.arange(48)), frames=Lifted(sweep.frames, np.arange(48)))
    found = track(spoilt, curves)
    assert np.flatnonzero(found.flags).tolist() == list(lost)
    centre = sweep.grid.centre_mm
    true = (spoilt.truth[0].inv() * spoilt.truth).apply(centre)[:, 2]
    assert abs(found.image.apply(centre)[-1, 2] - true[-1]) < 0.06 * true[-1]
