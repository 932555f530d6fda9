"""Poses are the same to the last bit whatever the number of threads."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from speckle3d.core import threads
from speckle3d.corrections import correct
from speckle3d.tracking import track


def poses_of(tracking, sweep):
    modes = correct(tracking, sweep, ["orientation", "pose"])
    return {
        "image": tracking.image.as_matrix(),
        "covariance": tracking.covariance,
        "subset": tracking.subset.as_matrix(),
        "flags": tracking.flags,
    } | {mode: m.poses.as_matrix() for mode, m in modes.items()}


def test_poses_do_not_depend_on_threads(sweep, curves, many_threads):
    part = sweep.part(0, 40)
    parallel = poses_of(track(part, curves), part)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threads, "cores", lambda: 1)
        single = poses_of(track(part, curves), part)
    for name, values in single.items():
        np.testing.assert_array_equal(parallel[name], values, err_msg=name)


class OneBuffer:
    """Frames that all come in the same memory, for one reader at a time."""

    def __init__(self, frames):
        self._frames, self.shape, self.dtype = frames, frames.shape, frames.dtype
        self._buffer, self._alone = np.empty(frames.shape[1:], frames.dtype), threading.Lock()

    def __getitem__(self, index):
        assert self._alone.acquire(blocking=False), "read by two threads at once"
        try:
            self._buffer[:] = self._frames[index]
            return self._buffer
        finally:
            self._alone.release()


def test_frames_that_share_their_memory_are_read_one_at_a_time(sweep, curves, many_threads):
    part = sweep.part(0, 24)
    from_buffer = track(replace(part, frames=OneBuffer(part.frames)), curves)
    np.testing.assert_array_equal(from_buffer.image.as_matrix(), track(part, curves).image.as_matrix())
    assert not from_buffer.flags.any()
