import numpy as np
import pytest
from drifting import CENTRE_MM, drifting_poses, hand_sweep
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.geometry import elevational_steps, skew
from speckle3d.correction.curves import (
    AXES,
    CorrectedChain,
    correction_matrices,
    curve_basis,
)


def chain_of(seed, frames=40, axes=AXES, curves="time", turns=0):
    rng = np.random.default_rng(seed)
    poses = drifting_poses(hand_sweep(rng, frames, turns=turns), rng)
    basis = curve_basis(axes, elevational_steps(poses, CENTRE_MM), curves)
    return poses, CorrectedChain.of(poses, axes, basis)


@pytest.mark.parametrize("curves", ["time", "distance"])
def test_poses_are_equation_1_written_out(curves):
    poses, chain = chain_of(2, curves=curves)
    coefficients = np.random.default_rng(2).normal(0.0, 0.3, 30)
    s, c = poses.as_matrix(), correction_matrices(chain.values(coefficients))
    t = s[0] @ c[0] @ np.linalg.inv(s[0])
    expected = [t @ s[0]]
    for f in range(1, len(s)):
        t = t @ s[f] @ c[f] @ np.linalg.inv(s[f])
        expected.append(t @ s[f])
    np.testing.assert_allclose(chain.poses(coefficients), expected, atol=1e-10)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), curves=st.sampled_from(["time", "distance"]))
def test_twists_are_the_derivative_of_every_frame(seed, curves):
    _, chain = chain_of(seed, frames=12, curves=curves)
    rng = np.random.default_rng(seed)
    coefficients, point = rng.normal(0.0, 0.2, 30), rng.uniform(0.0, 40.0, 3)
    poses = chain.poses(coefficients)
    turn, shift = chain.twists(coefficients, poses)
    where = poses[:, :3, :3] @ point + poses[:, :3, 3]
    motion = skew(where) @ -turn + shift
    h = 1e-6
    for k, unit in enumerate(np.eye(30)):
        difference = chain.poses(coefficients + h * unit) - chain.poses(coefficients - h * unit)
        slope = (difference[:, :3, :3] @ point + difference[:, :3, 3]) / (2 * h)
        # Central differences: h^2 times third derivatives, and rounding 1e-14 / h; 60 mm lever.
        np.testing.assert_allclose(motion[:, :, k], slope, atol=2e-6)
