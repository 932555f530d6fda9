"""Angles as published, steps between poses, and what no rotation, pose or clock can be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import (
    nearest_rotation,
    roll_yaw_tilt,
    rotation_from_fixed_angles,
    rotations_from_quaternions,
    transforms_from_matrices,
)

TURN = st.floats(-np.pi + 1e-6, np.pi - 1e-6)
YAW = st.floats(-np.pi / 2 + 1e-3, np.pi / 2 - 1e-3)


@given(psi=TURN, phi=YAW, theta=TURN)
def test_matrix_is_equation_2_of_housden_2008_and_angles_come_back(psi, phi, theta):
    (cf, cp, ct), (sf, sp, st_) = np.cos([phi, psi, theta]), np.sin([phi, psi, theta])
    expected = [
        [cf * cp, st_ * sf * cp - ct * sp, ct * sf * cp + st_ * sp],
        [cf * sp, st_ * sf * sp + ct * cp, ct * sf * sp - st_ * cp],
        [-sf, st_ * cf, ct * cf],
    ]
    rotation = rotation_from_fixed_angles(psi, phi, theta)
    np.testing.assert_allclose(rotation.as_matrix(), expected, atol=1e-14)
    # A milliradian from the singularity, rounding of 1e-16 grows as 1/cos(yaw) squared, to 1e-10.
    np.testing.assert_allclose(roll_yaw_tilt(rotation), [psi, phi, theta], atol=1e-9)


def test_quaternions_are_scalar_first_and_a_bad_one_is_named():
    rotation = rotations_from_quaternions([[np.cos(0.1), np.sin(0.1), 0, 0]], "q")
    np.testing.assert_allclose(rotation.as_rotvec(), [[0.2, 0, 0]])
    for value, index in ((0.5, r"q\[3\]"), (np.nan, r"q\[3, 0\]")):
        q = np.tile([1.0, 0, 0, 0], (5, 1))
        q[3, 0] = value
        with pytest.raises(InvalidInputError, match=index):
            rotations_from_quaternions(q, "q")
    with pytest.raises(InvalidInputError):
        rotations_from_quaternions([1.0, 0, 0, 0], "q")


@pytest.mark.parametrize("diagonal", [(1, 1, -1, 1), (1, 1, 1.001, 1), (1, 1, 1, 2), (np.inf, 1, 1, 1)])
def test_single_precision_is_rigid_enough_and_what_is_not_rigid_is_named(diagonal):
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[1, :3, :3] = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    transforms = transforms_from_matrices(matrices.astype(np.float32), "poses")
    np.testing.assert_allclose(transforms.as_matrix(), matrices, atol=1e-4)
    matrices[2] = np.diag(diagonal)
    with pytest.raises(InvalidInputError, match=r"tracker\[2"):
        transforms_from_matrices(matrices, "tracker")


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), columns=st.sampled_from([2, 3]))
def test_no_rotation_is_nearer_than_the_nearest(seed, columns):
    rng = np.random.default_rng(seed)
    noisy = Rotation.random(4, rng=rng).as_matrix()[:, :, :columns] + 0.2 * rng.normal(size=(4, 3, columns))
    nearest = nearest_rotation(noisy)
    neighbours = (
        Rotation.from_rotvec(rng.normal(0, 0.1, (20, 1, 3))) * Rotation.from_matrix(nearest)
    ).as_matrix()
    far = [np.sum((r[..., :columns] - noisy) ** 2, axis=(-2, -1)) for r in (nearest, neighbours)]
    np.testing.assert_allclose(np.linalg.det(nearest), 1.0)
    assert (far[0] <= far[1] + 1e-12).all()
    np.testing.assert_allclose(nearest_rotation(np.diag([1.0, 1.0, -0.5])), np.eye(3), atol=1e-15)
