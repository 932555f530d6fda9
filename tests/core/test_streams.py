"""A sensor's samples between its times, across gaps, and beyond its ends."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedPoses, TimedRotations


def steady(rate_rad_s, times):
    """Constant angular velocity, for which spherical interpolation is exact."""
    return Rotation.from_rotvec(np.outer(times, rate_rad_s))


def test_poses_slerp_and_move_linearly_between_uneven_samples():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.01, 0.15, 20))
    rate, velocity = rng.normal(0.0, 3.0, 3), rng.normal(0.0, 50.0, 3)
    stream = TimedPoses(times, RigidTransform.from_components(np.outer(times, velocity), steady(rate, times)))
    queries = np.append(rng.uniform(times[0], times[-1], 30), times)
    poses = stream.at(queries)
    np.testing.assert_allclose(poses.translation, np.outer(queries, velocity), atol=1e-9)
    turns = TimedRotations(times, steady(rate, times)).at(queries)
    for rotation in (poses.rotation, turns):
        assert (rotation.inv() * steady(rate, queries)).magnitude().max() < 1e-7


def test_gaps_and_times_outside_the_samples_are_not_covered():
    times = np.array([0.0, 0.1, 0.2, 0.6, 0.7])
    stream = TimedRotations(times, steady([1.0, 0, 0], times), max_gap_s=0.2)
    queries = [0.15, 0.2, 0.4, 0.6, 0.65, -0.001, 0.701, np.nan]
    assert stream.covers(queries).tolist() == [True, True, False, True, True, False, False, False]
    for time_s in (0.4, -0.001, 0.701, np.nan):
        with pytest.raises(InsufficientDataError):
            stream.at([0.1, time_s])


@pytest.mark.parametrize("times", [[], [0.0, 0.1], [0.0, 0.2, 0.1]])
def test_samples_without_as_many_increasing_times_are_refused(times):
    samples = Rotation.from_quat(np.tile([0.0, 0, 0, 1], (3 if times else 0, 1)))
    with pytest.raises(InvalidInputError):
        TimedRotations(np.array(times), samples)
