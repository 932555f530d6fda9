"""Poses from pair measurements made of known trajectories."""

from dataclasses import replace

import numpy as np
import pair_planes
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.poses import ERROR_STEPS, RelativePoses
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion.trajectory import edges_of, solve_trajectory

CENTRE_MM = np.array([19.0, 20.0, 0.0])
PLAIN = 1e6
"""Deviations within which no pair loses weight."""


def read_as(first, second, motions, planes):
    """A table of pairs' in-plane motions, and their planes from (coefficients, covariance) of each."""
    coefficients, covariance = zip(*planes, strict=True)
    first, second, pairs = np.array(first), np.array(second), len(motions)
    motion, errors = (np.array(part) for part in zip(*motions, strict=True))
    table = CorrelationTable(first, second, np.ones((pairs, 1), np.float32), motion, errors)
    return table, pair_planes.from_coefficients(first, second, coefficients, np.array(covariance))


def solve(pairs, frames, huber=2.0):
    return solve_trajectory(pairs, frames, CENTRE_MM, huber).poses


def elevation(poses):
    return poses.apply(CENTRE_MM)[:, 2]


# ---- one pair ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_signed_pair_lies_on_its_plane(sign):
    plane = sign * np.array([0.3, 0.011, -0.017]), np.diag([1e-4, 1e-8, 2e-8])
    pose = edges_of(*read_as([3], [5], [((0.2, -0.1, 0.03), np.eye(3))], [plane])).poses[0]
    for x, y in ((0, 0), (10, -5), (-15, 15)):
        assert abs(pose.apply([x, y, 0.0])[2] - sign * (0.3 + 0.011 * x - 0.017 * y)) < 1e-12
    assert np.allclose(pose.translation[:2], [0.2, -0.1])
    assert np.isclose(pose.rotation.as_euler("ZYX")[0], 0.03)


def test_covariance_is_in_the_order_x_y_z_tilt_yaw_roll():
    inplane = np.array([[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]]) * 1e-4
    plane_cov = np.array([[4.0, 0.4, 0.5], [0.4, 5.0, 0.6], [0.5, 0.6, 6.0]]) * 1e-6
    read = read_as([0], [1], [((0.0, 0.0, 0.0), inplane)], [((0.3, 0.0, 0.0), plane_cov)])
    (c,) = edges_of(*read).covariance
    expected, yaw_changes_sign = np.zeros((6, 6)), np.array([1.0, -1.0, 1.0])
    expected[np.ix_([0, 1, 5], [0, 1, 5])] = inplane
    # z = a, yaw = -b, tilt = c: offsets and slopes keep their covariances.
    expected[np.ix_([2, 4, 3], [2, 4, 3])] = plane_cov * np.outer(yaw_changes_sign, yaw_changes_sign)
    # In-plane variances carry a floor.
    np.testing.assert_allclose(c, expected, rtol=1e-4)


# ---- the graph ---------------------------------------------------------------------------------------------


def pose_of(x, y, z, tilt, yaw, roll):
    return RigidTransform.from_components([x, y, z], Rotation.from_euler("xyz", [tilt, yaw, roll]))


def graph_of(rows):
    """Edges from (first, second, pose, covariance)."""
    first, second, poses, covariance = zip(*rows, strict=True)
    poses = RigidTransform.concatenate(list(poses))
    return RelativePoses(np.array(first), np.array(second), poses, np.array(covariance))


def subset(pairs, index):
    """Some of the edges."""
    return RelativePoses(pairs.first[index], pairs.second[index], pairs.poses[index], pairs.covariance[index])


def neighbours():
    """Pairs of near frames of a hand that travels 0.1 mm a frame, with errors as claimed; and its poses."""
    rng, t = np.random.default_rng(1), np.arange(40)
    turns = 0.007 * np.column_stack([np.sin(t / 9), np.cos(t / 7), np.sin(t / 5)])
    position = np.column_stack([0.3 * np.sin(t / 8), 0.3 * np.cos(t / 6), 0.1 * t])
    truth = RigidTransform.from_components(position, Rotation.from_euler("xyz", turns))
    sigma2 = np.diag([3e-3, 1e-3, 8e-3, 2e-4, 2e-4, 1e-4]) ** 2
    rows = [
        (i, j, truth[i].inv() * truth[j] * pose_of(*rng.multivariate_normal(np.zeros(6), sigma2)), sigma2)
        for j in t[1:]
        for i in range(max(0, j - 3), j)
    ]
    return graph_of(rows), truth[0].inv() * truth


def test_poses_of_a_sweep_are_recovered_about_any_centre():
    pairs, truth = neighbours()
    centre = RigidTransform.from_translation(CENTRE_MM)
    off = solve(pairs, len(truth)).inv() * (centre * truth * centre.inv())
    # Some 40 steps of 0.004 mm and 1e-4 rad, in a random walk.
    assert np.abs(off.apply(CENTRE_MM) - CENTRE_MM).max() < 0.08
    assert off.rotation.magnitude().max() < 0.003


def test_one_false_pair_among_many_is_overruled():
    pairs, truth = neighbours()
    wrong = (pairs.first == 17) & (pairs.second == 19)
    false = RigidTransform.from_translation(np.outer(wrong, [0, 0, 1.0])) * pairs.poses
    clean, robust, plain = (
        elevation(solve(p, len(truth), huber=h))[-1]
        for p, h in ((pairs, 2.0), (replace(pairs, poses=false), 2.0), (replace(pairs, poses=false), PLAIN))
    )
    assert abs(robust - clean) < 0.25 * abs(plain - clean)


# ---- covariance --------------------------------------------------------------------------------------------


def test_a_chain_of_equal_steps_is_a_random_walk():
    """More frames than covariances are computed for; those between are interpolated."""
    frames, step = 250, np.diag([4e-4, 1e-4, 9e-4, 1e-8, 1e-8, 1e-8])
    assert frames > 2 * ERROR_STEPS
    first = np.arange(frames - 1)
    still = RigidTransform.from_translation(np.zeros((frames - 1, 3)))
    pairs = RelativePoses(first, first + 1, still, np.tile(step, (frames - 1, 1, 1)))
    walk = solve_trajectory(pairs, frames, CENTRE_MM)
    assert walk.covariance.shape == (frames, 6, 6)
    np.testing.assert_allclose(
        walk.covariance, np.arange(frames)[:, None, None] * step, rtol=1e-3, atol=1e-12
    )
    np.testing.assert_allclose(walk.covariance, walk.covariance.transpose(0, 2, 1))


# ---- frames that no pair places ----------------------------------------------------------------------------


def test_a_frame_that_is_held_alone_lies_between_its_neighbours_and_is_not_trusted():
    (pairs, truth), lone = neighbours(), 17
    without_lone = subset(pairs, (pairs.first != lone) & (pairs.second != lone))
    estimate, full = (solve_trajectory(p, len(truth), CENTRE_MM, 2.0) for p in (without_lone, pairs))
    before, at, after = elevation(estimate.poses)[lone - 1 : lone + 2]
    assert abs(at - (before + after) / 2) < 1e-3
    neighbour_frames = np.delete(np.arange(len(truth)), lone)
    assert np.abs(elevation(estimate.poses) - elevation(full.poses))[neighbour_frames].max() < 0.03
    deviation = np.sqrt(np.diagonal(estimate.covariance, axis1=1, axis2=2))
    # Two edges of 1 mm and 0.05 rad side by side.
    np.testing.assert_allclose(deviation[lone], np.repeat([1.0, 0.05], 3) / np.sqrt(2), rtol=0.05)
    assert (deviation[lone] > 4 * deviation[neighbour_frames].max(axis=0)).all()
