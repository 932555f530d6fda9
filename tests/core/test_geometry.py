import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.geometry import (
    nearest_rotation,
    relative_poses,
    require_finite,
    require_increasing,
    roll_yaw_tilt,
    rotation_from_fixed_angles,
    rotations_from_quaternions,
    transforms_from_matrices,
)

TURN = st.floats(-np.pi + 1e-6, np.pi - 1e-6)
YAW = st.floats(-np.pi / 2 + 1e-3, np.pi / 2 - 1e-3)


def random_poses(seed, count):
    rng = np.random.default_rng(seed)
    return RigidTransform.from_components(rng.normal(0, 100, (count, 3)), Rotation.random(count, rng=rng))


@settings(deadline=None)
@given(roll=TURN, yaw=YAW, tilt=TURN)
def test_angles_survive_the_round_trip(roll, yaw, tilt):
    found = roll_yaw_tilt(rotation_from_fixed_angles(roll, yaw, tilt))
    # A milliradian from the singularity, rounding of 1e-16 grows as 1/cos(yaw) squared, to 1e-10.
    np.testing.assert_allclose(found, [roll, yaw, tilt], atol=1e-9)


@settings(deadline=None)
@given(psi=TURN, phi=YAW, theta=TURN)
def test_matrix_is_equation_2_of_housden_2008(psi, phi, theta):
    (cf, cp, ct), (sf, sp, st_) = np.cos([phi, psi, theta]), np.sin([phi, psi, theta])
    expected = [
        [cf * cp, st_ * sf * cp - ct * sp, ct * sf * cp + st_ * sp],
        [cf * sp, st_ * sf * sp + ct * cp, ct * sf * sp - st_ * cp],
        [-sf, st_ * cf, ct * cf],
    ]
    found = rotation_from_fixed_angles(psi, phi, theta).as_matrix()
    np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.parametrize(("angles", "axis"), [((0.1, 0, 0), 2), ((0, 0.1, 0), 1), ((0, 0, 0.1), 0)])
def test_roll_yaw_and_tilt_turn_about_z_y_and_x(angles, axis):
    np.testing.assert_allclose(rotation_from_fixed_angles(*angles).as_rotvec(), 0.1 * np.eye(3)[axis])


def test_angles_broadcast():
    assert roll_yaw_tilt(rotation_from_fixed_angles(np.zeros(5), 0.1, 0.2)).shape == (5, 3)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_relative_poses_compose_back_to_the_chain(seed):
    poses = random_poses(seed, 6)
    steps = relative_poses(poses)
    assert len(steps) == 5
    chained = poses[0]
    for i in range(5):
        chained = chained * steps[i]
    np.testing.assert_allclose(chained.as_matrix(), poses[5].as_matrix(), atol=1e-10)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_relative_poses_do_not_depend_on_the_world(seed):
    poses, world = random_poses(seed, 4), random_poses(seed + 1, 1)
    moved = world * poses
    np.testing.assert_allclose(
        relative_poses(moved).as_matrix(), relative_poses(poses).as_matrix(), atol=1e-10
    )


def test_quaternions_are_scalar_first():
    rotation = rotations_from_quaternions([[np.cos(0.1), np.sin(0.1), 0, 0]], "q")
    np.testing.assert_allclose(rotation.as_rotvec(), [[0.2, 0, 0]])


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [(3, 0.5, r"q\[3\].*0\.5"), (2, np.nan, r"q\[\(2, 0\)\]")],
)
def test_a_bad_quaternion_is_named_by_index(index, value, message):
    q = np.tile([1.0, 0, 0, 0], (5, 1))
    q[index, 0] = value
    with pytest.raises(InvalidInputError, match=message):
        rotations_from_quaternions(q, "q")


def test_quaternions_of_another_shape_are_refused():
    with pytest.raises(InvalidInputError, match=r"\(4,\)"):
        rotations_from_quaternions([1.0, 0, 0, 0], "q")


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_rigid_matrices_pass_even_in_single_precision(seed):
    matrices = random_poses(seed, 3).as_matrix()
    found = transforms_from_matrices(matrices.astype(np.float32), "poses")
    np.testing.assert_allclose(found.as_matrix(), matrices, atol=1e-4)


@pytest.mark.parametrize(
    "spoil",
    [
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.0, 1.0, 1.001, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.eye(4) + np.outer([0, 0, 0, 1], [0.01, 0, 0, 0]),
    ],
    ids=["mirrored", "scaled", "homogeneous", "perspective"],
)
def test_a_matrix_that_is_not_rigid_is_named_by_index(spoil):
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[2] = spoil
    with pytest.raises(InvalidInputError, match=r"tracker\[2\]"):
        transforms_from_matrices(matrices, "tracker")


def test_matrices_of_another_shape_or_not_finite_are_refused():
    with pytest.raises(InvalidInputError, match=r"tracker.*\(4, 4\)$"):
        transforms_from_matrices(np.eye(4), "tracker")
    matrices = np.tile(np.eye(4), (2, 1, 1))
    matrices[1, 0, 3] = np.inf
    with pytest.raises(InvalidInputError, match=r"tracker\[\(1, 0, 3\)\].*inf"):
        transforms_from_matrices(matrices, "tracker")


def test_require_finite_names_the_first():
    with pytest.raises(InvalidInputError, match=r"x\[1\].*nan"):
        require_finite(np.array([0.0, np.nan, np.inf]), "x")


@pytest.mark.parametrize("times", [[0.0, 0.1, 0.1], [0.0, 0.2, 0.1]])
def test_times_that_stand_still_or_run_back_are_named_by_index(times):
    with pytest.raises(InvalidInputError, match=r"t\[2\]"):
        require_increasing(times, "t")


def test_times_must_be_a_row():
    with pytest.raises(InvalidInputError, match=r"t: .*\(1, 2\)"):
        require_increasing([[0.0, 1.0]], "t")


def test_a_yaw_of_a_right_angle_is_no_reason_to_warn():
    # Roll and tilt are then one angle, and which of them it is given to does not matter.
    rotation = rotation_from_fixed_angles(0.3, np.pi / 2, -0.2)
    again = rotation_from_fixed_angles(*roll_yaw_tilt(rotation))
    assert (rotation.inv() * again).magnitude() < 1e-7


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), columns=st.sampled_from([2, 3]))
def test_no_rotation_is_nearer_than_the_nearest(seed, columns):
    rng = np.random.default_rng(seed)
    given_ = Rotation.random(4, rng=rng).as_matrix()[:, :, :columns] + 0.2 * rng.normal(size=(4, 3, columns))
    found = nearest_rotation(given_)
    others = (Rotation.from_rotvec(rng.normal(0, 0.1, (20, 1, 3))) * Rotation.from_matrix(found)).as_matrix()
    far = [np.sum((one[..., :columns] - given_) ** 2, axis=(-2, -1)) for one in (found, others)]
    np.testing.assert_allclose(np.linalg.det(found), 1.0)
    assert (far[0] <= far[1] + 1e-12).all()


def test_the_nearest_rotation_to_a_mirror_is_no_mirror():
    np.testing.assert_allclose(nearest_rotation(np.diag([1.0, 1.0, -0.5])), np.eye(3), atol=1e-15)
