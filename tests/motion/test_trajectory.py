"""Poses from pair measurements made of known trajectories."""

from dataclasses import replace

import numpy as np
import pair_planes
import pytest
from scipy.linalg import logm
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.geometry import relative_poses
from speckle3d.core.relative import RelativePoses
from speckle3d.matching.inplane import InPlaneMotion
from speckle3d.matching.schedule import PairSchedule, TrajectorySettings
from speckle3d.matching.table import CorrelationTable
from speckle3d.motion import trajectory
from speckle3d.motion.signs import Strangers, likeliest_path, on_path
from speckle3d.motion.trajectory import edges_of, solve_trajectory

CENTRE_MM = np.array([19.0, 20.0, 0.0])
SIGMA_MM = 0.45
PLAIN = 1e6
"""Deviations within which no pair loses weight."""


def hand(z_mm, seed=0, turn_deg=0.4):
    """Poses about the centre along `z_mm`, with slow turns and in-plane motion, the first at the identity."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, len(z_mm))[:, None]
    waves = np.sin(2 * np.pi * (rng.uniform(0.5, 2, 5) * t + rng.uniform(0, 1, 5))) * [0.4, 0.4, 1, 1, 1]
    tilt_yaw_roll = np.deg2rad(turn_deg) * waves[:, 2:]
    moved = np.column_stack([waves[:, :2], z_mm])
    poses = RigidTransform.from_components(moved, Rotation.from_euler("xyz", tilt_yaw_roll))
    return poses[0].inv() * poses


def read_as(first, second, motions, planes):
    """A table of pairs' in-plane motions, and their planes from (coefficients, covariance) of each."""
    coefficients, covariance = zip(*planes, strict=True)
    first, second, pairs = np.array(first), np.array(second), len(motions)
    table = CorrelationTable(first, second, np.ones((pairs, 1), np.float32), np.ones(pairs), tuple(motions))
    return table, pair_planes.made(first, second, coefficients, np.array(covariance))


def measure(poses, first, second, rng, relative_noise=0.03, noise_mm=0.004):
    """What the stages before would tell of one pair: in-plane motion and an unsigned plane."""
    pose = poses[first].inv() * poses[second]
    x, y, z = pose.translation
    roll, yaw, tilt = pose.rotation.as_euler("ZYX")
    a = z + rng.normal() * np.hypot(relative_noise * z, noise_mm)
    slopes = np.array([-np.sin(yaw), np.cos(yaw) * np.sin(tilt)]) + 2e-4 * rng.normal(size=2)
    side = 1.0 if a >= 0 else -1.0
    variance = [(relative_noise * z) ** 2 + noise_mm**2 + 0.02**2, 4e-8, 4e-8]
    plane = np.array([side * a, *(side * slopes)]), np.diag(variance)
    return InPlaneMotion(x, y, roll, np.diag([1e-5, 1e-6, 1e-8])), plane


def correlation(plane):
    return float(np.exp(-(plane[0][0] ** 2) / (2 * SIGMA_MM**2)))


def follow(poses, seed=1, settings=None, **noise):
    """Read the sweep as it comes: schedule, measure; then settle the signs; returns the edges."""
    rng = np.random.default_rng(seed)
    settings = settings or TrajectorySettings()
    schedule, read = PairSchedule(settings), []
    for frame in range(len(poses)):
        every = {first: measure(poses, first, frame, rng, **noise) for first in schedule.references(frame)}
        usable = {k: v for k, v in every.items() if correlation(v[1]) >= settings.least_correlation}
        schedule.settle(frame, {k: correlation(plane) for k, (_, plane) in every.items()})
        if frame:
            assert usable, f"frame {frame} is out of reach"
        read += [(first, frame, *usable[first]) for first in usable]
    table, planes = read_as(*zip(*read, strict=True))
    nobody = Strangers(np.zeros(0, int), np.zeros(0, int), 0.0)
    return edges_of(table, on_path(planes, likeliest_path(planes, len(poses), 0.1, nobody)))


def solved(pairs, frames, centre_mm=CENTRE_MM, huber=2.0):
    return solve_trajectory(pairs, frames, np.asarray(centre_mm), huber).poses


def elevation(poses):
    return poses.apply(CENTRE_MM)[:, 2]


def about_centre(poses):
    centre = RigidTransform.from_translation(CENTRE_MM)
    return centre * poses * centre.inv()


def uneven(frames, length_mm, seed=0):
    speed = np.clip(1 + 0.8 * np.sin(np.linspace(0, 19, frames - 1) + seed), 0.1, None)
    return length_mm * np.concatenate([[0], np.cumsum(speed) / speed.sum()])


def reversal():
    forward = uneven(90, 7.0)
    return np.concatenate([forward, forward[-2::-1]])


def there_and_back_twice():
    return 2.0 * np.sin(np.linspace(0, 4 * np.pi, 240))


TRAJECTORIES = {
    "uneven speed": uneven(120, 12.0),
    "reversal": reversal(),
    "there and back twice": there_and_back_twice(),
}


# ---- whole sweeps ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_poses_are_recovered(name):
    z = TRAJECTORIES[name]
    truth = about_centre(hand(z))
    found = solved(follow(hand(z)), len(z))
    np.testing.assert_allclose(found[0].as_matrix(), np.eye(4), atol=1e-12)
    travel = np.abs(np.diff(z)).sum()
    # Pairs of about 0.3 mm, right to 3 % and 0.004 mm each, make a random walk: 0.02 mm per root of mm.
    allowed = 0.02 * np.sqrt(travel) * 3 + 0.02
    assert np.abs(elevation(found) - elevation(truth)).max() < allowed
    off = found.inv() * truth
    assert np.abs(off.apply(CENTRE_MM) - CENTRE_MM)[:, :2].max() < 0.05
    # 2e-4 per pair, likewise: 0.01 degrees times the root of some 100 pairs in a row.
    assert np.rad2deg(off.rotation.magnitude()).max() < 0.25


# ---- one pair ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_signed_pair_lies_on_its_plane(sign):
    plane = sign * np.array([0.3, 0.011, -0.017]), np.diag([1e-4, 1e-8, 2e-8])
    pose = edges_of(*read_as([3], [5], [InPlaneMotion(0.2, -0.1, 0.03)], [plane])).poses[0]
    for x, y in ((0, 0), (10, -5), (-15, 15)):
        assert abs(pose.apply([x, y, 0.0])[2] - sign * (0.3 + 0.011 * x - 0.017 * y)) < 1e-12
    assert np.allclose(pose.translation[:2], [0.2, -0.1])
    assert np.isclose(pose.rotation.as_euler("ZYX")[0], 0.03)


def test_covariance_is_in_the_order_x_y_z_tilt_yaw_roll():
    inplane = np.array([[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]]) * 1e-4
    plane_cov = np.array([[4.0, 0.4, 0.5], [0.4, 5.0, 0.6], [0.5, 0.6, 6.0]]) * 1e-6
    read = read_as([0], [1], [InPlaneMotion(0, 0, 0, inplane)], [((0.3, 0.0, 0.0), plane_cov)])
    (c,) = edges_of(*read).covariance
    x, y, z, tilt, yaw, roll = range(6)
    np.testing.assert_allclose(c, c.T)
    # In-plane variances carry a floor of a micrometre and a few hundredths of a milliradian.
    np.testing.assert_allclose(c[[x, y, roll], [x, y, roll]], [1e-4, 2e-4, 3e-4], rtol=0.02)
    np.testing.assert_allclose(c[[x, x, y], [y, roll, roll]], [1e-5, 2e-5, 3e-5])
    # z = a, yaw = -b, tilt = c: offsets and slopes keep their covariances, yaw's change sign.
    np.testing.assert_allclose(c[[z, tilt, yaw], [z, tilt, yaw]], [4e-6, 6e-6, 5e-6])
    np.testing.assert_allclose(c[[z, z, tilt], [tilt, yaw, yaw]], [5e-7, -4e-7, -6e-7])
    assert (c[np.ix_([x, y, roll], [z, tilt, yaw])] == 0).all()


# ---- the graph ---------------------------------------------------------------------------------------------


def pose_of(x, y, z, tilt, yaw, roll):
    return RigidTransform.from_components([x, y, z], Rotation.from_euler("xyz", [tilt, yaw, roll]))


def graph_of(rows):
    """Edges from (first, second, pose, covariance)."""
    first, second, poses, covariance = zip(*rows, strict=True)
    poses = RigidTransform.concatenate(list(poses))
    return RelativePoses(np.array(first), np.array(second), poses, np.array(covariance))


def random_covariance(rng, scale=(0.02, 0.02, 0.03, 0.003, 0.003, 0.002)):
    root = (0.3 * rng.normal(size=(6, 6)) + np.eye(6)) * np.array(scale)[:, None]
    return root @ root.T


def random_graph(seed, frames=6, turn=0.15):
    """Large relative motions, correlated errors of very different size, and loops that do not close."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(frames, 6)) * [3, 3, 3, turn, turn, turn]
    truth = [pose_of(*s) for s in steps]
    edges = [(i, j) for j in range(1, frames) for i in range(j) if i == j - 1 or rng.uniform() < 0.6]
    rows = []
    for i, j in edges:
        covariance = random_covariance(rng)
        error = rng.multivariate_normal(np.zeros(6), covariance)
        rows.append((i, j, truth[i].inv() * truth[j] * pose_of(*error), covariance))
    return graph_of(rows), RigidTransform.concatenate(truth)


def kept(pairs, which):
    """Some of the edges."""
    return RelativePoses(pairs.first[which], pairs.second[which], pairs.poses[which], pairs.covariance[which])


def dense_residuals(pairs, matrices):
    """Weighted twists, by matrix logarithms, of every pair's disagreement."""
    out = []
    for i, j, pose, covariance in zip(
        pairs.first, pairs.second, pairs.poses.as_matrix(), pairs.covariance, strict=True
    ):
        log = np.real(logm(np.linalg.inv(pose) @ np.linalg.inv(matrices[i]) @ matrices[j]))
        twist = np.array([log[0, 3], log[1, 3], log[2, 3], log[2, 1], log[0, 2], log[1, 0]])
        out.append(np.linalg.cholesky(np.linalg.inv(covariance)).T @ twist)
    return np.concatenate(out)


def matrices_of(x):
    return [np.eye(4), *(pose_of(*p).as_matrix() for p in x.reshape(-1, 6))]


@pytest.mark.parametrize("seed", range(2))
def test_poses_are_the_least_squares_ones(seed, monkeypatch):
    pairs, truth = random_graph(seed)
    start = truth[0].inv() * truth[1:]
    x0 = np.column_stack([start.translation, start.rotation.as_euler("xyz")]).ravel()
    dense = least_squares(lambda x: dense_residuals(pairs, matrices_of(x)), x0, method="lm", xtol=1e-12)
    monkeypatch.setattr(trajectory, "ROUNDS", 20)
    found = solved(pairs, len(truth), np.zeros(3), PLAIN)
    # Gauss-Newton drops the curvature of the logarithm, of the size of the residuals: the minimum is the
    # same to a few micrometres, and its cost to second order in that.
    np.testing.assert_allclose(found.as_matrix(), matrices_of(dense.x), atol=2e-3)
    cost = 0.5 * np.sum(dense_residuals(pairs, list(found.as_matrix())) ** 2)
    assert cost < dense.cost * 1.001


@pytest.mark.parametrize("axis", range(6), ids=["x", "y", "z", "tilt", "yaw", "roll"])
def test_a_pair_uncertain_in_one_direction_gives_way_in_that_direction_alone(axis):
    """Two steps and the jump over both disagree in one direction; the step unsure of it takes it all up."""
    sure = np.diag([1e-6] * 3 + [1e-8] * 3)
    unsure = sure.copy()
    unsure[axis, axis] *= 1e6
    gap = np.zeros(6)
    gap[axis] = 0.02
    still = np.zeros(6)
    pairs = graph_of(
        [(0, 1, pose_of(*still), unsure), (1, 2, pose_of(*still), sure), (0, 2, pose_of(*gap), sure)]
    )
    first, second = relative_poses(solved(pairs, 3, np.zeros(3), PLAIN))
    np.testing.assert_allclose(first.as_matrix(), pose_of(*gap).as_matrix(), atol=1e-5)
    np.testing.assert_allclose(second.as_matrix(), np.eye(4), atol=1e-5)


def test_one_false_pair_among_many_is_overruled():
    z = uneven(40, 4.0)
    pairs = follow(hand(z))
    wrong = (pairs.first == 17) & (pairs.second == 19)
    assert wrong.sum() == 1
    false = RigidTransform.from_translation(np.outer(wrong, [0, 0, 1.0])) * pairs.poses
    clean, robust, plain = (
        elevation(solved(p, len(z), huber=h))[-1]
        for p, h in ((pairs, 2.0), (replace(pairs, poses=false), 2.0), (replace(pairs, poses=false), 1e6))
    )
    assert abs(robust - clean) < 0.25 * abs(plain - clean)


# ---- covariance --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_marginal_covariance_is_that_of_many_draws():
    """Errors in each frame's own axes, over draws of all pairs' errors."""
    draws, frames = 400, 6
    pairs, _ = random_graph(4, frames)
    truth = solved(pairs, frames, np.zeros(3), PLAIN)
    # The same graph without misfit, pairs right but for what is drawn.
    exact = truth[pairs.first].inv() * truth[pairs.second]
    claimed = solve_trajectory(replace(pairs, poses=exact), frames, np.zeros(3), PLAIN, True).covariance
    rng = np.random.default_rng(12)
    root = np.linalg.cholesky(pairs.covariance)
    errors = np.empty((draws, frames, 6))
    for k in range(draws):
        twist = np.einsum("eij,ej->ei", root, rng.normal(size=(len(pairs), 6)))
        off = RigidTransform.from_exp_coords(twist[:, [3, 4, 5, 0, 1, 2]])
        found = solved(replace(pairs, poses=exact * off), frames, np.zeros(3), PLAIN)
        errors[k] = (truth.inv() * found).as_exp_coords()[:, [3, 4, 5, 0, 1, 2]]
    assert (claimed[0] == 0).all()
    for covariance, error in zip(claimed[1:], errors.transpose(1, 0, 2)[1:], strict=True):
        seen = np.cov(error.T)
        deviation = np.sqrt(np.diag(covariance))
        # A deviation from 400 draws is itself right to 3.5 %, a correlation to 0.05.
        np.testing.assert_allclose(np.sqrt(np.diag(seen)), deviation, rtol=0.15)
        np.testing.assert_allclose(
            seen / np.outer(deviation, deviation), covariance / np.outer(deviation, deviation), atol=0.25
        )


def test_a_chain_of_equal_steps_is_a_random_walk():
    """More frames than covariances are computed for; those between are interpolated."""
    frames, step = 250, np.diag([4e-4, 1e-4, 9e-4, 1e-8, 1e-8, 1e-8])
    assert frames > 2 * trajectory.KNOWN_FRAMES
    first = np.arange(frames - 1)
    still = RigidTransform.from_translation(np.zeros((frames - 1, 3)))
    pairs = RelativePoses(first, first + 1, still, np.tile(step, (frames - 1, 1, 1)))
    found = solve_trajectory(pairs, frames, CENTRE_MM, with_covariance=True)
    assert found.covariance.shape == (frames, 6, 6)
    np.testing.assert_allclose(
        found.covariance, np.arange(frames)[:, None, None] * step, rtol=1e-3, atol=1e-12
    )
    np.testing.assert_allclose(found.covariance, found.covariance.transpose(0, 2, 1))


# ---- frames that no pair places ----------------------------------------------------------------------------


def test_a_frame_that_is_held_alone_lies_between_its_neighbours_and_is_not_trusted():
    z, lone = uneven(40, 4.0), 17
    pairs = follow(hand(z))
    measured = kept(pairs, (pairs.first != lone) & (pairs.second != lone))
    found = solve_trajectory(measured, len(z), CENTRE_MM, with_covariance=True)
    before, at, after = elevation(found.poses)[lone - 1 : lone + 2]
    # Midway, as both edges say the same; to a micrometre, a hundredth of the step.
    assert abs(at - (before + after) / 2) < 1e-3
    assert after - before > 0.05
    full = solve_trajectory(pairs, len(z), CENTRE_MM, with_covariance=True)
    others = np.delete(np.arange(len(z)), lone)
    # Its neighbours lose nothing but the pairs with it.
    assert np.abs(elevation(found.poses) - elevation(full.poses))[others].max() < 0.03
    deviation = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    # Two edges of 1 mm and 0.05 rad side by side.
    np.testing.assert_allclose(deviation[lone, :3], 1 / np.sqrt(2), rtol=0.05)
    np.testing.assert_allclose(deviation[lone, 3:], 0.05 / np.sqrt(2), rtol=0.05)
    assert (deviation[lone] > 4 * deviation[others].max(axis=0)).all()
