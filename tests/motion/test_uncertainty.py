"""What poses' covariance is made of: the graph's own, the scale, false turns, structure."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.core.reconstruction import SharedErrors
from speckle3d.motion.uncertainty import (
    SCALE_CHANGE_MM,
    TURN_CHANGE_MM,
    claimed_covariance,
    shared_covariance,
)
from speckle3d.study.pose_errors import joint_errors

CENTRE_MM = np.array([7.0, 22.0, 0.0])
Z_MM = np.concatenate([np.linspace(0, 10, 51), np.linspace(10, 0, 51)[1:]])
POSES = RigidTransform.from_translation(np.column_stack([0 * Z_MM, 0 * Z_MM, Z_MM]))
X, Y, Z, TILT, YAW, ROLL = range(6)


def covariance(scale=0.0, turn=(0.0, 0.0), share=0.0, independent=1e-8):
    graph = np.tile(independent * np.eye(6), (len(POSES), 1, 1))
    return claimed_covariance(POSES, graph, CENTRE_MM, SharedErrors(scale, 0.0, np.array(turn)), share)


def test_an_error_of_scale_grows_on_the_way_and_mostly_comes_back():
    deviation = np.sqrt(covariance(scale=0.02)[:, Z, Z])
    # Two hundredths of ten millimetres; what changes along the way does not cancel on the way back.
    assert deviation[50] == pytest.approx(0.02 * np.sqrt(100 + SCALE_CHANGE_MM * 10), rel=1e-3)
    assert deviation[100] == pytest.approx(0.02 * np.sqrt(SCALE_CHANGE_MM * 20), rel=1e-2)


def test_a_false_turn_bends_the_sweep():
    yaw = covariance(turn=(1e-3, 0.0))
    # Turned by z / 1000 at z, the centre is off by the mean turn times z; of a walk, by its integral.
    bent = 1e-3 * np.sqrt(10**4 / 4 + TURN_CHANGE_MM * 10**3 / 3)
    still = covariance()
    assert np.sqrt(yaw[50, X, X] - still[50, X, X]) == pytest.approx(bent, rel=2e-2)
    assert yaw[50, X, YAW] > 0
    tilt = covariance(turn=(0.0, 1e-3))
    assert np.sqrt(tilt[50, Y, Y] - still[50, Y, Y]) == pytest.approx(bent, rel=2e-2)
    assert tilt[50, Y, TILT] < 0


def test_structure_that_stays_makes_lateral_motion_and_roll_uncertain():
    plain, tissue = covariance(independent=1e-4), covariance(share=0.1, independent=1e-4)
    growth = np.diagonal(tissue[10]) / np.diagonal(plain[10])
    assert growth[X] > 2
    assert growth[ROLL] > 2
    np.testing.assert_allclose(growth[[Z, TILT, YAW]], 1.0)
    # Half of the share for each mm along z.
    assert np.sqrt(tissue[50, X, X] - tissue[100, X, X]) == pytest.approx(0.55, rel=0.02)


# ---- all frames together ----------------------------------------------------------------------------------

CLAIMS = SharedErrors(0.02, 0.03, np.array([1e-3, 2e-3]))
ONE_WAY = POSES[:51]


def growing(poses):
    """Covariance that grows with the way, in lines and in angles, which have some of it in common."""
    root = np.diag([0.01, 0.01, 0.02, 5e-4, 5e-4, 3e-4]) @ (np.eye(6) + 0.3)
    return np.linspace(0.0, 1.0, len(poses))[:, None, None] * (root @ root.T)


@pytest.mark.parametrize("frames", [1, 2, 51, 101])
def test_each_frame_has_the_covariance_that_was_claimed(frames):
    poses = POSES[:frames]
    claims = growing(poses) + shared_covariance(poses, CENTRE_MM, CLAIMS)
    for common in (CLAIMS, None):
        factors = joint_errors(claims, poses, CENTRE_MM, common).factors
        joint = np.einsum("mia,mib->iab", factors, factors)
        np.testing.assert_allclose(joint, claims, rtol=1e-6, atol=1e-12)


def test_what_is_shared_stretches_and_what_has_grown_is_a_random_walk():
    claims = growing(ONE_WAY) + shared_covariance(ONE_WAY, CENTRE_MM, CLAIMS)
    errors = joint_errors(claims, ONE_WAY, CENTRE_MM, CLAIMS)
    walk = growing(ONE_WAY)[-1, Z, Z] / 10.0 + SCALE_CHANGE_MM * 0.02**2
    for i, j in ((0, 50), (10, 40), (20, 25)):
        apart = errors.factors[:, j, Z] - errors.factors[:, i, Z]
        away = (j - i) / 5.0
        expected = np.hypot(0.02, 0.03) ** 2 * away**2 + walk * away
        assert apart @ apart == pytest.approx(expected, rel=0.02)


def test_the_claim_of_two_frames_does_not_hang_on_rounding():
    """A direction that is as good as certain stays so, however the covariance is rounded."""
    claims = growing(ONE_WAY)
    claims[:, :, YAW] = claims[:, YAW, :] = 0.0
    claims[:, YAW, YAW] = 1e-20
    noisy_claims = claims * (1.0 + 1e-15 * np.random.default_rng(1).normal(size=claims.shape))
    factors = [joint_errors(c, ONE_WAY, CENTRE_MM, None).factors for c in (claims, noisy_claims)]
    exact, rough = (f[:, 10].T @ f[:, 40] for f in factors)
    np.testing.assert_allclose(exact, rough, rtol=1e-9, atol=1e-15)
