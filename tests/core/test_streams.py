import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError, InvalidInputError
from speckle3d.core.streams import TimedPoses, TimedRotations


def steady(rate_rad_s, times):
    """Constant angular velocity, for which spherical interpolation is exact."""
    return Rotation.from_rotvec(np.outer(times, rate_rad_s))


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_slerp_follows_a_steady_turn_exactly_between_uneven_samples(seed):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.15, 20))
    rate = rng.normal(0.0, 3.0, 3)
    asked = rng.uniform(times[0], times[-1], 30)
    found = TimedRotations(times, steady(rate, times)).at(asked)
    assert (found.inv() * steady(rate, asked)).magnitude().max() < 1e-7


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_poses_slerp_and_move_linearly(seed):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.15, 20))
    rate, velocity = rng.normal(0.0, 3.0, 3), rng.normal(0.0, 50.0, 3)
    stream = TimedPoses(times, RigidTransform.from_components(np.outer(times, velocity), steady(rate, times)))
    asked = rng.uniform(times[0], times[-1], 30)
    found = stream.at(asked)
    np.testing.assert_allclose(found.translation, np.outer(asked, velocity), atol=1e-9)
    assert (found.rotation.inv() * steady(rate, asked)).magnitude().max() < 1e-7


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_samples_come_back_as_they_are_even_beside_gaps(seed):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 1.0, 12))
    rotations = Rotation.random(12, rng=rng)
    stream = TimedRotations(times, rotations, max_gap_s=0.2)
    assert stream.covers(times).all()
    assert (stream.at(times).inv() * rotations).magnitude().max() < 1e-7


def test_interpolation_takes_the_short_way_whatever_the_quaternion_sign():
    q = np.array([[1.0, 0, 0, 0], [-np.cos(0.1), -np.sin(0.1), 0, 0]])
    stream = TimedRotations(np.array([0.0, 0.1]), Rotation.from_quat(q, scalar_first=True))
    np.testing.assert_allclose(stream.at([0.05]).as_rotvec(), [[0.1, 0, 0]], atol=1e-12)


def test_a_gap_is_not_covered_and_not_bridged():
    times = np.array([0.0, 0.1, 0.2, 0.6, 0.7])
    stream = TimedRotations(times, steady([1.0, 0, 0], times), max_gap_s=0.2)
    asked = [0.15, 0.2, 0.4, 0.6, 0.65]
    assert stream.covers(asked).tolist() == [True, True, False, True, True]
    with pytest.raises(InsufficientDataError, match=r"do not cover time 0.4000 s \(1 of 5 asked times\)"):
        stream.at(asked)


@pytest.mark.parametrize("outside", [-0.001, 0.301, np.nan])
def test_a_time_outside_the_samples_is_refused(outside):
    times = np.array([0.0, 0.1, 0.2, 0.3])
    stream = TimedPoses(times, RigidTransform.identity(4))
    assert not stream.covers([outside]).any()
    with pytest.raises(InsufficientDataError, match=r"samples span 0.0000 to 0.3000 s"):
        stream.at([0.1, outside])


@pytest.mark.parametrize("kind", [TimedRotations, TimedPoses])
def test_a_single_sample_serves_its_own_time_alone(kind):
    value = Rotation.identity(1) if kind is TimedRotations else RigidTransform.identity(1)
    stream = kind(np.array([0.5]), value)
    assert stream.covers([0.5, 0.6]).tolist() == [True, False]
    assert len(stream.at([0.5, 0.5])) == 2
    with pytest.raises(InsufficientDataError):
        stream.at([0.6])


@pytest.mark.parametrize("kind", [TimedRotations, TimedPoses])
def test_a_clock_that_runs_back_is_named_by_index(kind):
    value = Rotation.identity(3) if kind is TimedRotations else RigidTransform.identity(3)
    with pytest.raises(InvalidInputError, match=r"time_s\[2\]"):
        kind(np.array([0.0, 0.2, 0.1]), value)


@pytest.mark.parametrize("kind", [TimedRotations, TimedPoses])
def test_as_many_samples_as_times(kind):
    value = Rotation.identity(3) if kind is TimedRotations else RigidTransform.identity(3)
    with pytest.raises(InvalidInputError, match="as many samples as times, got 3 and 2"):
        kind(np.array([0.0, 0.1]), value)


def test_no_samples_are_refused():
    with pytest.raises(InvalidInputError, match="at least one sensor sample"):
        TimedRotations(np.array([]), Rotation.from_quat(np.empty((0, 4))))
