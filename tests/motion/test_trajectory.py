"""Signs and poses from pair measurements made of known trajectories."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import logm
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InsufficientDataError
from speckle3d.core.geometry import relative_poses
from speckle3d.motion.inplane import InPlaneMotion
from speckle3d.motion.planes import PairPlane
from speckle3d.motion.trajectory import (
    PairMeasurement,
    PairSchedule,
    SignedPair,
    SignResolver,
    TrajectorySettings,
    sign_pair,
    solve_trajectory,
)

CENTRE_MM = np.array([19.0, 20.0, 0.0])
SIGMA_MM = 0.45
STILL = np.ones(3, bool)


def hand(z_mm, seed=0, turn_deg=0.4):
    """Poses about the centre along `z_mm`, with slow turns and in-plane motion, the first at the identity."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, len(z_mm))[:, None]
    waves = np.sin(2 * np.pi * (rng.uniform(0.5, 2, 5) * t + rng.uniform(0, 1, 5))) * [0.4, 0.4, 1, 1, 1]
    tilt_yaw_roll = np.deg2rad(turn_deg) * waves[:, 2:]
    moved = np.column_stack([waves[:, :2], z_mm])
    poses = RigidTransform.from_components(moved, Rotation.from_euler("xyz", tilt_yaw_roll))
    return poses[0].inv() * poses


def measure(poses, first, second, rng, relative_noise=0.03, noise_mm=0.004):
    """What the stages before would tell of one pair: in-plane motion, unsigned plane, correlation."""
    pose = poses[first].inv() * poses[second]
    x, y, z = pose.translation
    roll, yaw, tilt = pose.rotation.as_euler("ZYX")
    a = z + rng.normal() * np.hypot(relative_noise * z, noise_mm)
    slopes = np.array([-np.sin(yaw), np.cos(yaw) * np.sin(tilt)]) + 2e-4 * rng.normal(size=2)
    side = 1.0 if a >= 0 else -1.0
    variance = [(relative_noise * z) ** 2 + noise_mm**2 + 0.02**2, 4e-8, 4e-8]
    plane = PairPlane(side * a, *(side * slopes), np.diag(variance), STILL)
    motion = InPlaneMotion(x, y, roll, np.diag([1e-5, 1e-6, 1e-8]))
    return PairMeasurement(first, second, motion, plane)


def correlation(pair):
    return float(np.exp(-(pair.plane.offset_mm**2) / (2 * SIGMA_MM**2)))


def follow(poses, seed=1, settings=None, **noise):
    """Read the sweep as it comes: schedule, measure, sign; returns the signed pairs."""
    rng = np.random.default_rng(seed)
    settings = settings or TrajectorySettings()
    schedule, resolver, signed = PairSchedule(settings), SignResolver(), []
    for frame in range(len(poses)):
        every = [measure(poses, first, frame, rng, **noise) for first in schedule.references(frame)]
        usable = [p for p in every if correlation(p) >= settings.least_correlation]
        schedule.settle(frame, {p.first: correlation(p) for p in every})
        if frame:
            assert usable, f"frame {frame} is out of reach"
            signs = resolver.place(usable)
            signed += [sign_pair(p, p.plane, s) for p, s in zip(usable, signs, strict=True)]
        resolver.forget(schedule.needed(frame))
    return signed


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


def pause():
    rng = np.random.default_rng(5)
    first = uneven(50, 4.0)
    return np.concatenate([first, 4.0 + 0.004 * rng.normal(size=25), 4.0 + uneven(50, 4.0)[1:]])


def there_and_back_twice():
    return 2.0 * np.sin(np.linspace(0, 4 * np.pi, 240))


TRAJECTORIES = {
    "uneven speed": uneven(120, 12.0),
    "reversal": reversal(),
    "pause": pause(),
    "slow": np.linspace(0, 3.0, 120),
    "there and back twice": there_and_back_twice(),
}


# ---- signs and poses --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_poses_are_recovered(name):
    z = TRAJECTORIES[name]
    truth = about_centre(hand(z))
    found = solve_trajectory(follow(hand(z)), len(z), CENTRE_MM)
    np.testing.assert_allclose(found[0].as_matrix(), np.eye(4), atol=1e-12)
    travel = np.abs(np.diff(z)).sum()
    # Pairs of about 0.3 mm, right to 3 % and 0.004 mm each, make a random walk: 0.02 mm per root of mm.
    allowed = 0.02 * np.sqrt(travel) * 3 + 0.02
    assert np.abs(elevation(found) - elevation(truth)).max() < allowed
    off = found.inv() * truth
    assert np.abs(off.apply(CENTRE_MM) - CENTRE_MM)[:, :2].max() < 0.05
    # 2e-4 per pair, likewise: 0.01 degrees times the root of some 100 pairs in a row.
    assert np.rad2deg(off.rotation.magnitude()).max() < 0.25


def test_a_sweep_read_backwards_is_the_same_sweep_mirrored():
    """Images do not tell the side: the first motion counts as positive."""
    z = uneven(60, 5.0)
    for direction in (1, -1):
        truth = hand(direction * z, turn_deg=0.0)
        found = solve_trajectory(follow(truth), len(z), CENTRE_MM)
        assert (np.diff(elevation(found)) > -0.02).all()
        assert abs(elevation(found)[-1] / 5.0 - 1) < 0.05


def test_without_noise_poses_are_exact():
    z = TRAJECTORIES["reversal"]
    truth = about_centre(hand(z))
    found = solve_trajectory(follow(hand(z), relative_noise=0.0, noise_mm=1e-9), len(z), CENTRE_MM)
    # 2e-4 of slope noise per pair remains, over a centre that does not feel it.
    assert np.abs(elevation(found) - elevation(truth)).max() < 0.02


def test_key_frames_are_farther_apart_where_the_probe_is_slow():
    settings = TrajectorySettings(recent=2, key_frames=3, key_correlation=0.9)
    schedule = PairSchedule(settings)
    z = np.concatenate([np.linspace(0, 0.3, 31), 0.3 + 0.1 * np.arange(1, 31)])
    keys = [0]
    for frame in range(len(z)):
        references = schedule.references(frame)
        assert references == sorted(set(references), reverse=True)
        assert all(r < frame for r in references)
        assert len(references) <= 12  # however long the sweep
        rho = {r: float(np.exp(-((z[frame] - z[r]) ** 2) / (2 * SIGMA_MM**2))) for r in references}
        schedule.settle(frame, rho)
        if frame and frame in schedule.needed(frame + 10):
            keys.append(frame)
        assert set(schedule.references(frame + 1)) <= schedule.needed(frame)
    apart = np.diff(z[keys])
    # Correlation 0.9 is 0.207 mm: the first frame past it, a step of 0.01 or 0.1 mm later at most.
    assert (apart >= 0.2).all()
    assert (apart <= 0.31).all()


# ---- one pair ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_signed_pair_lies_on_its_plane(sign):
    plane = PairPlane(0.3, 0.011, -0.017, np.diag([1e-4, 1e-8, 2e-8]), STILL)
    pair = PairMeasurement(3, 5, InPlaneMotion(0.2, -0.1, 0.03, np.eye(3) * 1e-6), plane)
    pose = sign_pair(pair, plane, sign).pose
    for x, y in ((0, 0), (10, -5), (-15, 15)):
        z = pose.apply([x, y, 0.0])[2]
        assert abs(z - sign * (0.3 + 0.011 * x - 0.017 * y)) < 1e-12
    assert np.allclose(pose.translation[:2], [0.2, -0.1])
    assert np.isclose(pose.rotation.as_euler("ZYX")[0], 0.03)


def test_the_other_sign_is_the_mirror_image_in_the_first_frames_plane():
    plane = PairPlane(0.3, 0.011, -0.017, np.eye(3), STILL)
    pair = PairMeasurement(0, 1, InPlaneMotion(0.2, -0.1, 0.03), plane)
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    plus, minus = (sign_pair(pair, plane, s).pose.as_matrix() for s in (1.0, -1.0))
    np.testing.assert_allclose(mirror @ plus @ mirror, minus, atol=1e-12)


def test_covariance_is_in_the_order_x_y_z_tilt_yaw_roll():
    inplane = np.array([[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]]) * 1e-4
    plane_cov = np.array([[4.0, 0.4, 0.5], [0.4, 5.0, 0.6], [0.5, 0.6, 6.0]]) * 1e-6
    plane = PairPlane(0.3, 0.0, 0.0, plane_cov, STILL)
    signed = sign_pair(PairMeasurement(0, 1, InPlaneMotion(0, 0, 0, inplane), plane), plane, 1.0)
    x, y, z, tilt, yaw, roll = range(6)
    c = signed.covariance
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


def random_covariance(rng, scale=(0.02, 0.02, 0.03, 0.003, 0.003, 0.002)):
    root = (0.3 * rng.normal(size=(6, 6)) + np.eye(6)) * np.array(scale)[:, None]
    return root @ root.T


def random_graph(seed, frames=6, turn=0.15):
    """Large relative motions, correlated errors of very different size, and loops that do not close."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(frames, 6)) * [3, 3, 3, turn, turn, turn]
    truth = [pose_of(*s) for s in steps]
    edges = [(i, j) for j in range(1, frames) for i in range(j) if i == j - 1 or rng.uniform() < 0.6]
    pairs = []
    for i, j in edges:
        covariance = random_covariance(rng)
        error = rng.multivariate_normal(np.zeros(6), covariance)
        pairs.append(SignedPair(i, j, truth[i].inv() * truth[j] * pose_of(*error), covariance))
    return pairs, truth


def dense_residuals(pairs, matrices):
    """Weighted twists, by matrix logarithms, of every pair's disagreement."""
    out = []
    for pair in pairs:
        relative = np.linalg.inv(matrices[pair.first]) @ matrices[pair.second]
        log = np.real(logm(np.linalg.inv(pair.pose.as_matrix()) @ relative))
        twist = np.array([log[0, 3], log[1, 3], log[2, 3], log[2, 1], log[0, 2], log[1, 0]])
        out.append(np.linalg.cholesky(np.linalg.inv(pair.covariance)).T @ twist)
    return np.concatenate(out)


def matrices_of(x):
    return [np.eye(4), *(pose_of(*p).as_matrix() for p in x.reshape(-1, 6))]


@pytest.mark.parametrize("seed", range(3))
def test_poses_are_the_least_squares_ones(seed):
    pairs, truth = random_graph(seed)
    start = [truth[0].inv() * pose for pose in truth[1:]]
    x0 = np.concatenate([[*p.translation, *p.rotation.as_euler("xyz")] for p in start])
    dense = least_squares(lambda x: dense_residuals(pairs, matrices_of(x)), x0, method="lm", xtol=1e-12)
    found = solve_trajectory(pairs, len(truth), np.zeros(3), TrajectorySettings(huber=1e6), rounds=20)
    # Gauss-Newton drops the curvature of the logarithm, of the size of the residuals: the minimum is the
    # same to a few micrometres, and its cost to second order in that.
    np.testing.assert_allclose(found.as_matrix(), matrices_of(dense.x), atol=2e-3)
    cost = 0.5 * np.sum(dense_residuals(pairs, list(found.as_matrix())) ** 2)
    assert cost < dense.cost * 1.001


def test_a_few_rounds_are_enough():
    pairs, truth = random_graph(7)
    settings = TrajectorySettings(huber=1e6)
    found, longer = (solve_trajectory(pairs, len(truth), np.zeros(3), settings, n) for n in (6, 40))
    np.testing.assert_allclose(found.as_matrix(), longer.as_matrix(), atol=1e-4)


def test_pairs_that_agree_are_met_exactly_wherever_the_centre_is():
    _, truth = random_graph(1)
    local = RigidTransform.concatenate(truth)
    local = local[0].inv() * local
    edges = [(i, j) for j in range(1, 6) for i in range(j)]
    pairs = [SignedPair(i, j, local[i].inv() * local[j], 1e-4 * np.eye(6)) for i, j in edges]
    for centre in (np.zeros(3), CENTRE_MM):
        shift = RigidTransform.from_translation(centre)
        found = solve_trajectory(pairs, 6, centre)
        np.testing.assert_allclose(found.as_matrix(), (shift * local * shift.inv()).as_matrix(), atol=1e-8)


@pytest.mark.parametrize("axis", range(6), ids=["x", "y", "z", "tilt", "yaw", "roll"])
def test_a_pair_uncertain_in_one_direction_gives_way_in_that_direction_alone(axis):
    """Two steps and the jump over both disagree in one direction; the step unsure of it takes it all up."""
    sure = np.diag([1e-6] * 3 + [1e-8] * 3)
    unsure = sure.copy()
    unsure[axis, axis] *= 1e6
    gap = np.zeros(6)
    gap[axis] = 0.02
    pairs = [
        SignedPair(0, 1, pose_of(0, 0, 0, 0, 0, 0), unsure),
        SignedPair(1, 2, pose_of(0, 0, 0, 0, 0, 0), sure),
        SignedPair(0, 2, pose_of(*gap), sure),
    ]
    found = solve_trajectory(pairs, 3, np.zeros(3), TrajectorySettings(huber=1e6))
    first, second = relative_poses(found)
    np.testing.assert_allclose(first.as_matrix(), pose_of(*gap).as_matrix(), atol=1e-5)
    np.testing.assert_allclose(second.as_matrix(), np.eye(4), atol=1e-5)


def test_one_false_pair_among_many_is_overruled():
    z = uneven(40, 4.0)
    truth = hand(z)
    pairs = follow(truth)
    worst = next(k for k, p in enumerate(pairs) if p.first == 17 and p.second == 19)
    false = RigidTransform.from_translation([0, 0, 1.0]) * pairs[worst].pose
    wrong = [*pairs[:worst], replace(pairs[worst], pose=false), *pairs[worst + 1 :]]
    clean, robust, plain = (
        elevation(solve_trajectory(p, len(z), CENTRE_MM, TrajectorySettings(huber=h)))[-1]
        for p, h in ((pairs, 2.0), (wrong, 2.0), (wrong, 1e6))
    )
    assert abs(robust - clean) < 0.25 * abs(plain - clean)


def test_a_frame_out_of_reach_is_named():
    pairs, truth = random_graph(0)
    cut = [p for p in pairs if p.second != 3]
    with pytest.raises(InsufficientDataError, match=r"frame 3: .* \(1 of 6 frames so\)"):
        solve_trajectory(cut, len(truth), CENTRE_MM)
    with pytest.raises(InsufficientDataError, match="frame 6: "):
        solve_trajectory(pairs, 8, CENTRE_MM)
