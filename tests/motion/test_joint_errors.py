"""Joint errors of all frames: each frame's covariance as claimed, and frames tied as a chain of bodies."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.reconstruction import SharedErrors
from speckle3d.motion.joint_errors import carried, chain_factors, joint_errors, turn_factors
from speckle3d.motion.uncertainty import changing_variance, common_factors, shared_covariance

CENTRE_MM = np.array([7.0, 22.0, 0.0])
SHARED = SharedErrors(0.02, 0.03, np.array([1e-3, 2e-3]))
STEP = np.diag([0.01, 0.01, 0.02, 5e-4, 5e-4, 3e-4]) ** 2


def curved(frames=90):
    t = np.linspace(0, 1, frames)
    turns = Rotation.from_rotvec(np.column_stack([0.1 * t, 0.2 * np.sin(3 * t), 0.05 * t]))
    return RigidTransform.from_components(np.column_stack([t, np.sin(2 * t), 15 * t]), turns)


def chain(poses, step=STEP):
    """Covariance of every frame, each having the error of the one before and one of its own."""
    centres = poses.apply(CENTRE_MM)
    covariance = np.zeros((len(poses), 6, 6))
    for k in range(1, len(poses)):
        carry = carried(centres[k] - centres[k - 1])
        covariance[k] = carry @ covariance[k - 1] @ carry.T + step
    return covariance


def assert_near(found, wanted, rtol):
    size = np.sqrt(np.einsum("...a,...b->...ab", *2 * [np.diagonal(wanted, axis1=-2, axis2=-1)]))
    assert np.abs(found - wanted).max() <= rtol * size.max()
    np.testing.assert_array_less(np.abs(found - wanted), rtol * size + 1e-12)


def test_each_frame_has_the_covariance_that_was_claimed():
    poses = curved()
    claimed = chain(poses) + shared_covariance(poses, CENTRE_MM, SHARED)
    for shared in (SHARED, None):
        assert_near(joint_errors(claimed, poses, CENTRE_MM, shared).covariance(), claimed, 1e-6)


def test_two_frames_have_in_common_what_came_before_the_earlier_one():
    poses = curved()
    grown = chain(poses)
    claimed = grown + shared_covariance(poses, CENTRE_MM, SHARED)
    errors = joint_errors(claimed, poses, CENTRE_MM, SHARED)
    common, variance = (of(poses, CENTRE_MM, SHARED) for of in (common_factors, changing_variance))
    centres = poses.apply(CENTRE_MM)
    for i, j in ((20, 70), (45, 50), (10, 89)):
        wanted = grown[i] @ carried(centres[j] - centres[i]).T + common[:, i].T @ common[:, j]
        wanted = wanted + np.diag(variance[i])
        size = np.sqrt(np.outer(np.diagonal(claimed[i]), np.diagonal(claimed[j])))
        np.testing.assert_array_less(
            np.abs(errors.factors[:, i].T @ errors.factors[:, j] - wanted), 0.02 * size
        )


def test_an_error_of_scale_alone_stretches_every_distance_alike():
    poses = curved()
    stretched = SharedErrors(0.0, 0.05, np.zeros(2))
    errors = joint_errors(shared_covariance(poses, CENTRE_MM, stretched), poses, CENTRE_MM, stretched)
    z = poses.apply(CENTRE_MM)[:, 2]
    for i, j in ((0, 89), (30, 60), (60, 61)):
        apart = errors.factors[:, j, 2] - errors.factors[:, i, 2]
        assert np.linalg.norm(apart) == pytest.approx(0.05 * (z[j] - z[i]), rel=1e-3)


def test_without_the_split_no_distance_on_a_one_way_sweep_is_claimed_surer():
    poses = curved()
    claimed = chain(poses) + shared_covariance(poses, CENTRE_MM, SHARED)
    split, old = (joint_errors(claimed, poses, CENTRE_MM, shared) for shared in (SHARED, None))
    for i, j in ((10, 80), (30, 50), (0, 89)):
        with_split, without = (np.linalg.norm(e.factors[:, j, 2] - e.factors[:, i, 2]) for e in (split, old))
        assert without > 0.97 * with_split


@pytest.mark.parametrize("frames", [1, 2, 3, 300])
def test_sweeps_of_any_length_keep_their_covariances(frames):
    poses = curved(frames) if frames > 1 else curved(2)[:1]
    claimed = chain(poses) + shared_covariance(poses, CENTRE_MM, SHARED)
    found = joint_errors(claimed, poses, CENTRE_MM, SHARED)
    assert len(found) == frames
    np.testing.assert_allclose(found.covariance(), claimed, rtol=1e-4, atol=1e-9 * claimed.max())


def test_a_probe_at_rest_without_errors_has_none():
    still = RigidTransform.identity(5)
    found = joint_errors(np.zeros((5, 6, 6)), still, CENTRE_MM, SHARED)
    assert found.factors.shape == (0, 5, 6)


def test_what_is_no_covariance_is_taken_for_the_nearest_that_is():
    poses = curved(30)
    wrong = chain(poses)
    wrong[:, 0, 0] = -1e-6
    found = joint_errors(wrong, poses, CENTRE_MM).covariance()
    assert np.isfinite(found).all()
    assert (np.linalg.eigvalsh(found) > -1e-12).all()


def test_a_sensor_that_wanders_turns_frames_and_bends_the_path():
    poses, time_s = curved(), np.linspace(0, 4, 90)
    factors = turn_factors(np.array([0.0, 0.01, 0.0]), 1e7, time_s, poses, CENTRE_MM)
    # Over so short a time it does not wander against the first frame at all.
    assert np.abs(factors).max() < 1e-4
    factors = turn_factors(np.array([0.002, 0.003, 0.004]), 0.01, time_s, poses, CENTRE_MM)
    deviation = np.sqrt((factors**2).sum(axis=0))
    # At knots the difference of two independent turns.
    np.testing.assert_allclose(deviation[-1, 3:], np.sqrt(2) * np.array([0.002, 0.003, 0.004]), rtol=1e-6)
    assert (deviation[-1, :2] > 0.0).all()


@pytest.mark.parametrize("least_mm", [1e-4, 1e-8, 1e-12, 0.0])
def test_a_component_without_an_error_of_its_own_leaves_the_others_theirs(least_mm):
    """Tilt and yaw carry errors into a place whose own was told to be rounding, or was split off."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        frames, own = 60, np.array([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3])
        own[which := rng.integers(0, 3)] = least_mm
        mixed = rng.normal(size=(6, 6))
        covariance = (mixed @ mixed.T * np.outer(own, own)) * np.linspace(0, 1, frames)[:, None, None]
        factors = chain_factors(covariance, np.outer(np.linspace(0, 20, frames), [0.2, 0.0, 1.0]))
        got = np.einsum("mia,mia->ia", factors, factors)[1:]
        wanted = np.diagonal(covariance, axis1=1, axis2=2)[1:]
        others = np.arange(6) != which
        # The floor under rounding is a millionth of the largest error; divided by nothing it was 1e58.
        np.testing.assert_allclose(got[:, others], wanted[:, others], rtol=1e-3)
        assert (got[:, which] <= wanted[:, which] + 1e-9).all()
