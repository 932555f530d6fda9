"""Stretches that images took for their mirror image, turned over again."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.relative import RelativePoses
from speckle3d.correction.fused.sides import on_felt_sides

FRAMES = 30


def test_steps_that_are_felt_to_go_back_are_turned_over():
    rng = np.random.default_rng(5)
    steps = np.column_stack([0.01 * rng.standard_normal((FRAMES, 2)), 0.15 + 0.02 * rng.random(FRAMES)])
    turns = Rotation.from_rotvec(0.002 * rng.standard_normal((FRAMES, 3)))
    path = [RigidTransform.identity()]
    for step, turn in zip(steps[1:], turns[1:], strict=True):
        path.append(path[-1] * RigidTransform.from_components(step, turn))
    true = RigidTransform.concatenate(path)
    first = np.concatenate([np.arange(FRAMES - 1), np.arange(FRAMES - 2)])
    second = first + np.repeat([1, 2], [FRAMES - 1, FRAMES - 2])
    right = RelativePoses(
        first, second, true[first].inv() * true[second], np.tile(1e-4 * np.eye(6), (first.size, 1, 1))
    )
    flip = np.zeros(FRAMES - 1, dtype=bool)
    flip[10:18] = True
    # What images give that take the stretch for its mirror image; its borders are crossed by no edge of two.
    inside = flip[first] & flip[second - 1]
    across = flip[first] != flip[second - 1]
    other = right.mirrored()
    wrong = np.where(inside[:, None, None], other.poses.as_matrix(), right.poses.as_matrix())
    seen = RelativePoses(
        first[~across], second[~across], RigidTransform.from_matrix(wrong[~across]), right.covariance[~across]
    )
    chain = [RigidTransform.identity()]
    for k in range(FRAMES - 1):
        chain.append(
            chain[-1] * seen.poses[int(np.flatnonzero((seen.first == k) & (seen.second == k + 1))[0])]
        )
    start = RigidTransform.concatenate(chain)
    assert np.abs(start.translation - true.translation).max() > 1.0
    edges, poses = on_felt_sides(seen, start, flip)
    np.testing.assert_allclose(poses.translation, true.translation, atol=1e-6)
    np.testing.assert_allclose(edges.poses.as_matrix(), right.poses.as_matrix()[~across], atol=1e-9)
    # Nothing felt, nothing changed.
    same, kept = on_felt_sides(seen, start, np.zeros(FRAMES - 1, dtype=bool))
    assert same is seen
    assert kept is start
