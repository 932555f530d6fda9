"""Paths through unsigned pairs against all paths as arrays, frame by frame."""

import numpy as np
import oracles

from speckle3d.kernels.signs import PathRules, follow_paths

RULES = PathRules(
    hypotheses=8, relative_error=0.1, placed=2.0, cap=9.0, turning_cost=2.0, trend_mm=0.3, same_mm=0.05,
    same_slope=0.005, apart_mm=0.3, apart_slope=0.01, apart_cost=4.0,
)  # fmt: skip


def wandering(rng, frames):
    """Pairs of a hand that pauses and turns back, with frames that no pair places."""
    z = np.cumsum(rng.normal(0.02, 0.08, frames))
    b = 0.02 * np.sin(np.arange(frames) / 7.0)
    pairs, unlike = [], []
    for frame in range(1, frames):
        if frame in (17, 18):
            continue
        before = np.arange(max(0, frame - 9), frame)
        apart = np.abs(z[frame] - z[before])
        near = before[apart < 0.4]
        pairs += [(i, frame) for i in (near if near.size else before[-1:])]
        unlike += [(i, frame) for i in before[apart > 0.7]]
    first, second = np.array(pairs).T
    moved = np.column_stack([z[second] - z[first], b[second] - b[first]])
    moved *= np.where(moved[:, :1] < 0, -1.0, 1.0)
    moved[:, 0] = np.abs(moved[:, 0] * (1 + 0.1 * rng.normal(size=first.size)) + 0.01)
    wrong = rng.uniform(size=first.size) < 0.1
    moved[wrong, 0] = rng.uniform(0, 0.8, wrong.sum())
    root = rng.normal(size=(first.size, 2, 2)) * [[0.02], [2e-3]]
    covariance = root @ root.transpose(0, 2, 1) + np.diag([4e-4, 1e-6])
    return first, second, moved, covariance, np.array(unlike, dtype=np.int64).reshape(-1, 2)


def test_the_path_is_the_likeliest_of_all_that_are_kept():
    frames, rules = 60, RULES
    for seed in range(6):
        first, second, moved, covariance, unlike = wandering(np.random.default_rng(seed), frames)
        every, path = np.arange(frames + 1), np.zeros((frames, 2))
        starts = np.searchsorted(second, every), np.searchsorted(unlike[:, 1], every)
        earlier = np.ascontiguousarray(unlike[:, 0])
        follow_paths(starts[0], first.copy(), moved, covariance, starts[1], earlier, rules, path)
        expected = oracles.likeliest_path(frames, first, second, moved, covariance, unlike, rules)
        np.testing.assert_allclose(path, expected, rtol=1e-7, atol=1e-9)
        assert np.ptp(path[:, 0]) > 0.5
