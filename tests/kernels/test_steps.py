"""Steps of readings against SciPy's slerp and products of transforms."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.geometry import components
from speckle3d.core.streams import TimedPoses
from speckle3d.core.sweep import Tracker
from speckle3d.correction.evidence import steps_between
from speckle3d.kernels.steps import Readings, steps_of_readings

CENTRE_MM = np.array([19.0, 20.0, 0.0])


def steps(tracker, first_s, second_s):
    out = np.empty((first_s.size, 6))
    readings = Readings(
        tracker.readings.time_s, *tracker.readings.components, *components(tracker.sensor_from_image)
    )
    steps_of_readings(readings, CENTRE_MM, first_s, second_s, out)
    return out


def tracker_of(rng, count, turn):
    turned = Rotation.from_rotvec(turn * rng.normal(size=(count, 3)))
    poses = RigidTransform.from_components(10 * rng.normal(size=(count, 3)), turned)
    mounting = RigidTransform.from_exp_coords(rng.normal(size=6))
    return Tracker(TimedPoses(np.cumsum(rng.uniform(0.02, 0.1, count)), poses, 1.0), mounting)


@pytest.mark.parametrize("turn", [0.0, 1e-7, 0.01, 1.0])
def test_steps_are_those_between_interpolated_poses(turn):
    rng = np.random.default_rng(4)
    tracker = tracker_of(rng, 40, turn)
    begin, end = tracker.readings.time_s[[0, -1]]
    first, second = rng.uniform(begin, end, (2, 60))
    first[:3], second[:3] = tracker.readings.time_s[[0, 5, -1]], tracker.readings.time_s[[-1, 6, 0]]
    expected = steps_between(tracker.world_from_image(first), tracker.world_from_image(second), CENTRE_MM)
    np.testing.assert_allclose(steps(tracker, first, second), expected, atol=1e-8)


def test_there_is_no_step_where_there_is_no_reading_and_none_at_all_with_one():
    rng = np.random.default_rng(5)
    found = steps(tracker_of(rng, 9, 1.0), np.array([np.nan, 0.2, 0.3]), np.array([0.2, np.nan, 0.3]))
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2], 0.0, atol=1e-12)
    tracker = tracker_of(rng, 1, 1.0)
    only = tracker.readings.time_s
    np.testing.assert_allclose(steps(tracker, only, only), 0.0, atol=1e-12)
