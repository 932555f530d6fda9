"""A sweep that comes back, tied to its way there."""

from dataclasses import replace

import numpy as np
import pytest

from speckle3d.config import Config
from speckle3d.io.curves import read_curves
from speckle3d.io.load import load_sweep
from speckle3d.motion.planes import PairPlane
from speckle3d.pipeline import track
from speckle3d.revisit import REACH_MM, _place


class Reordered:
    """Frames of a sweep in another order."""

    def __init__(self, frames, order):
        self._frames, self._order, self.dtype = frames, order, frames.dtype
        self.shape = (len(order), *frames.shape[1:])

    def __getitem__(self, index):
        return self._frames[int(self._order[index])]


@pytest.fixture(scope="module")
def there_and_back(shipped):
    """Frames of the shipped sweep on the way there, and others between them on the way back."""
    sweep = load_sweep(shipped / "phantom.h5")
    order = np.concatenate([np.arange(28, 70, 2), np.arange(69, 27, -2)])
    time_s = 0.04 * np.arange(order.size)
    return replace(
        sweep,
        frames=Reordered(sweep.frames, order),
        frame_time_s=time_s,
        truth=sweep.truth[order],
        tracker=None,
        orientation=None,
    )


def end_error(sweep, curves, **trajectory):
    tracked = track(sweep, curves, Config.model_validate({"trajectory": trajectory}))
    centre = sweep.grid.centre_mm
    true = (sweep.truth[0].inv() * sweep.truth[-1]).apply(centre)[2]
    return abs(tracked.image[-1].apply(centre)[2] - true), tracked


def test_coming_back_is_seen(there_and_back, shipped):
    curves = read_curves(shipped / "curves.h5")
    tied, found = end_error(there_and_back, curves)
    loose, alone = end_error(there_and_back, curves, revisit_mm=0.0)
    assert found.pairs > alone.pairs
    # Ten millimetres there and back, 1 % each way; frames that see the same speckle are right to 0.01 mm.
    assert tied < 0.03
    assert tied <= loose + 0.005


def test_one_way_nothing_is_revisited(shipped):
    sweep = load_sweep(shipped / "phantom.h5")
    curves = read_curves(shipped / "curves.h5")
    counts = {
        every: track(sweep, curves, Config.model_validate({"trajectory": {"revisit_mm": every}})).pairs
        for every in (0.0, 1.0)
    }
    assert counts[0.0] == counts[1.0]


def plane(offset_mm):
    return PairPlane(
        offset_mm, 0.0, 0.0, np.diag([4e-4, 1e-6, 1e-6]), np.ones(1, bool), np.zeros(1), np.ones(1)
    )


def test_distances_on_both_sides_place_a_frame():
    apart = np.array([-0.5, -0.3, -0.1, 0.1, 0.3, 0.5])
    found = _place(apart, [plane(abs(a + 0.14)) for a in apart], REACH_MM)
    assert found == pytest.approx(0.14, abs=0.02)


def test_a_place_that_could_be_either_of_two_is_not_taken():
    # All on one side and all alike: the frame may lie 0.3 mm before or behind.
    apart = np.array([0.0, 0.001, 0.002, 0.003])
    assert _place(apart, [plane(0.3)] * 4, REACH_MM) is None


def test_frames_without_common_speckle_speak_against_a_place_near_them():
    apart = np.array([0.0, 0.001, 0.002, 0.003, 0.4, 0.45])
    found = _place(apart, [plane(0.3)] * 4 + [None, None], REACH_MM)
    assert found == pytest.approx(0.3, abs=0.03)
