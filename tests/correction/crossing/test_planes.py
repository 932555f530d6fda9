"""A sweep on planes along a smooth path that scale and turns may bend."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from speckle3d.core.grid import ImageGrid
from speckle3d.correction.crossing.planes import BENDS, straighten
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.correction.crossing.sweep import CrossingSweep

GRID = ImageGrid(12, 16, 0.3, 0.35)


def straight_sweep(travel, image):
    stack = ImageStack(GRID)
    for index, z in enumerate(travel):
        stack.keep(index, image(z).astype(np.float32))
    poses = RigidTransform.from_translation(np.outer(travel, [0.0, 0.0, 1.0]))
    return CrossingSweep("sweep", stack, poses, GRID.centre_mm, 0.1, 1e-3)


def test_a_hand_that_dwells_does_not_draw_the_images():
    # Bright and dark change places at 5 mm, before which the hand stays.
    stripes = np.sign(np.sin(np.arange(16) * np.pi / 4 + 0.1)) * np.ones((12, 1))
    turns = []
    for pause in (np.zeros(0), np.full(60, 4.6)):
        travel = np.sort(np.concatenate([np.linspace(0.0, 10.0, 60), pause]))
        sweep = straighten(straight_sweep(travel, lambda z: 10.0 ** (0.3 * np.tanh(z - 5.0) * stripes)))
        z, level = sweep.planes.poses(np.zeros(BENDS))[:, 2, 3], sweep.texture[:, 6, 9]
        turns.append(np.interp(0.0, level[8:-8] * np.sign(level[-9]), z[8:-8]))
    # 0.05 mm is a seventh of the planes' spacing; weighed alike, frames at the pause draw by 0.2.
    assert abs(turns[1] - turns[0]) < 0.05


def test_frames_return_to_where_they_were_and_scale_stretches_about_the_middle():
    travel = np.linspace(0.0, 12.0, 80) + 0.05 * np.sin(np.arange(80))
    sweep = straight_sweep(travel, lambda z: np.full((12, 16), 1.0 + z))
    straight = straighten(sweep)
    bends = np.zeros(BENDS)
    back = straight.bent_frames(bends) * RigidTransform.from_translation(-sweep.centre_mm)
    np.testing.assert_allclose((back[0].inv() * back).translation, sweep.poses.translation, atol=1e-9)
    bends[0] = 0.1
    ends, before = (
        straight.bent_frames(b).translation[[0, straight.nearest, -1], 2] for b in (bends, 0 * bends)
    )
    np.testing.assert_allclose(ends - before[1], 1.1 * (before - before[1]), atol=1e-9)
    assert (straight.mean_rates() @ bends)[0] == pytest.approx(0.1, rel=1e-5)
