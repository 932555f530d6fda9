"""Graphs of relative poses against dense normal equations and SciPy's exponential coordinates."""

import numpy as np
import oracles
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.relative import RelativePoses
from speckle3d.kernels.graph import marginals, relax
from speckle3d.motion.trajectory import _graph

SWAPPED = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])


def edges_of(rng, frames, pairs, turn=0.3):
    """Measured relative poses between random ones, with errors of all sizes."""
    poses = RigidTransform.from_exp_coords(rng.normal(size=(frames, 6)) * [turn, turn, turn, 5, 5, 5])
    first, second = np.array(pairs).T
    wrong = RigidTransform.from_exp_coords(0.05 * rng.standard_t(2, (len(pairs), 6)))
    measured = poses[first].inv() * poses[second] * wrong
    root = rng.normal(size=(len(pairs), 6, 6))
    return poses, RelativePoses(
        first, second, measured, 0.01 * root @ root.transpose(0, 2, 1) + 0.001 * np.eye(6)
    )


PAIRS = {
    "a chain": [(k, k + 1) for k in range(6)],
    "neighbours": [(i, j) for j in range(1, 7) for i in range(max(0, j - 3), j)],
    "a return": [(k, k + 1) for k in range(6)] + [(0, 6), (1, 6)],
    "backwards": [(1, 0), (1, 2), (3, 2), (3, 4), (5, 4), (6, 5), (6, 2)],
}


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("huber", [1.0, 1e6])
def test_a_round_solves_the_normal_equations(name, huber):
    rng = np.random.default_rng(7)
    truth, edges = edges_of(rng, 7, PAIRS[name])
    start = truth * RigidTransform.from_exp_coords(0.1 * rng.normal(size=(7, 6)))
    information = np.stack([np.linalg.inv(c)[SWAPPED] for c in edges.covariance])
    problem = edges.first, edges.second, edges.poses, information, huber
    normal, gradient = oracles.pose_graph_step(start, *problem)
    step = np.concatenate([np.zeros(6), np.linalg.solve(normal, -gradient)]).reshape(7, 6)
    expected = (start * RigidTransform.from_exp_coords(step)).as_matrix()
    found = start.as_matrix()
    relax(_graph(edges, 7), found, huber, 1, 0.0)
    np.testing.assert_allclose(found, expected, atol=1e-9)

    frames = np.array([1, 4, 6])
    blocks = np.empty((3, 6, 6))
    marginals(_graph(edges, 7), start.as_matrix(), huber, frames, blocks)
    covariance = np.linalg.inv(normal)
    for frame, block in zip(frames, blocks, strict=True):
        own = slice(6 * frame - 6, 6 * frame)
        np.testing.assert_allclose(block, covariance[own, own], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 0.04, 0.07, 90.0, 179.9])
def test_errors_of_any_angle_are_as_scipy_has_them(degrees):
    rng = np.random.default_rng(1)
    axis = rng.normal(size=3)
    turned = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
    measured = RigidTransform.from_components([[1.0, -2.0, 3.0]], Rotation.concatenate([turned]))
    edges = RelativePoses(np.array([0]), np.array([1]), measured, 0.1 * np.eye(6)[None])
    start = RigidTransform.from_matrix(np.tile(np.eye(4), (2, 1, 1)))
    _, gradient = oracles.pose_graph_step(start, [0], [1], measured, 10.0 * np.eye(6)[None], 1e6)
    expected = RigidTransform.from_exp_coords(-gradient / (10.0 + 1e-9)).as_matrix()
    found = start.as_matrix()
    relax(_graph(edges, 2), found, 1e6, 1, 0.0)
    np.testing.assert_allclose(found[1], expected, atol=1e-8)


def test_rounds_end_when_settled():
    truth, edges = edges_of(np.random.default_rng(2), 7, PAIRS["neighbours"])
    some, more = truth.as_matrix(), truth.as_matrix()
    relax(_graph(edges, 7), some, 1e6, 50, 1e-9)
    relax(_graph(edges, 7), more, 1e6, 100, 0.0)
    np.testing.assert_allclose(some, more, atol=1e-7)
    np.testing.assert_array_equal(some[0], truth.as_matrix()[0])
