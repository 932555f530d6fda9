"""A tracker's path is looked at like a path: what no hand does is left out, what is odd is told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform
from sweep_examples import bmode_sweep

from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import Tracker
from speckle3d.io.pose_paths import checked_path

TIMES_S = np.arange(40) / 20


def path_after(change):
    """Readings that stay of a path of 0.5 mm a reading after a change of its places, and the notes."""
    places = np.array([100.0, 50.0, 0.0]) + np.arange(40)[:, None] * [0.0, 0.0, 0.5]
    change(places)
    sweep = bmode_sweep()
    sweep = replace(sweep, frame_time_s=np.linspace(0, 1.9, len(sweep)))
    readings = TimedPoses(TIMES_S, RigidTransform.from_translation(places))
    sweep, notes = checked_path(replace(sweep, tracker=Tracker(readings, None)), "tforms")
    return sweep.tracker.readings.time_s, notes


@pytest.mark.parametrize(
    ("rows", "place"), [(slice(10, 14), [0.0, 0.0, 0.0]), (slice(0, 3), [100.0, 72.0, 0.0])]
)
def test_poses_that_no_hand_reaches_are_no_readings(rows, place):
    """A lost tool that is written as the identity, and a jump of 22 mm at the beginning."""
    times, notes = path_after(lambda places: places.__setitem__(rows, place))
    np.testing.assert_array_equal(times, np.delete(TIMES_S, rows))
    assert f"{40 - times.size} of 40 left out" in notes[0]


def test_single_placements_all_stay():
    times, notes = path_after(lambda places: places.__setitem__((slice(None), 0), 50 * (np.arange(40) % 2)))
    assert times.size == 40
    assert "all are kept" in notes[0]


def test_a_tracker_at_rest_while_images_change_gives_a_note():
    _, notes = path_after(lambda places: places.__setitem__(slice(10, 30), places[10]))
    assert "the longest of 20 poses, 0.95 s from 0.500 s" in notes[0]
    _, notes = path_after(lambda places: places.__imul__(1e-4))
    assert "in metres" in notes[0]
