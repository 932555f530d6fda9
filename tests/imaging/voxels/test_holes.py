"""Filling of holes: against brute force, on any number of threads."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from speckle3d.core.volume import EMPTY, FILLED, MEASURED
from speckle3d.imaging.voxels.holes import boxes_within, fill_holes


def some_voxels(rng, shape, share):
    """Voxels and their states; what empty ones hold is nonsense."""
    voxels = rng.normal(100.0, 30.0, shape).astype(np.float32)
    state = np.where(rng.random(shape) < share, MEASURED, EMPTY).astype(np.uint8)
    voxels[state == EMPTY] = rng.choice([np.nan, np.inf, 0.0, -1e30], (state == EMPTY).sum())
    return voxels, state


def fill_by_definition(voxels, state, boxes):
    """The definition, voxel by voxel, in the order of the boxes (k, j, i)."""
    voxels_after, state_after = voxels.copy(), state.copy()
    for at in np.argwhere(state == EMPTY):
        for half in boxes:
            box = tuple(slice(max(c - h, 0), c + h + 1) for c, h in zip(at, half, strict=True))
            levels = voxels[box][state[box] == MEASURED]
            if levels.size:
                voxels_after[tuple(at)], state_after[tuple(at)] = levels.mean(dtype=np.float64), FILLED
                break
    return voxels_after, state_after


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    spacing=st.tuples(*[st.sampled_from([0.2, 0.25, 0.5, 0.7, 1.0, 3.0])] * 3),
    radius_mm=st.sampled_from([0.0, 0.3, 0.6, 1.0, 2.1]),
)
def test_boxes_in_mm_are_those_of_brute_force(seed, spacing, radius_mm):
    voxels, state = some_voxels(np.random.default_rng(seed), (6, 7, 9), 0.05)
    boxes = boxes_within(radius_mm, spacing)
    expected = fill_by_definition(voxels, state, boxes)
    fill_holes(voxels, state, radius_mm, spacing)
    np.testing.assert_array_equal(state, expected[1])
    np.testing.assert_array_equal(voxels[state == FILLED], expected[0][state == FILLED])
