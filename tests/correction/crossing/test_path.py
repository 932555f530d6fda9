"""A sweep as planes along a smooth path that scale and turns may bend."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.sweep import ImageGrid
from speckle3d.correction.crossing.path import BENDS, Path, straightened
from speckle3d.correction.crossing.stack import ImageStack
from speckle3d.correction.crossing.sweep import CrossingSweep


def wandering_path():
    at = (np.arange(61) - 30) * 0.35
    turns = Rotation.from_rotvec(
        np.stack([0.03 * np.sin(at / 6), 0.02 * np.cos(at / 8), 0.01 * at / 10], axis=1)
    )
    moved = np.stack([0.3 * np.sin(at / 7), 0.2 * np.cos(at / 5), at], axis=1)
    return Path(at, RigidTransform.from_components(moved, turns).as_matrix())


def test_scale_stretches_about_the_middle():
    path = wandering_path()
    bends = np.zeros(len(BENDS))
    bends[0] = 0.1
    bent = path.bent(bends)
    np.testing.assert_allclose(bent[30], path.planes[30], atol=1e-12)
    steps = [np.linalg.inv(p[:-1]) @ p[1:] for p in (path.planes, bent)]
    np.testing.assert_allclose(steps[1][:, 2, 3], np.exp(0.1) * steps[0][:, 2, 3], rtol=1e-12)
    np.testing.assert_allclose(steps[1][:, :2, 3], steps[0][:, :2, 3], atol=1e-12)


def test_twists_are_what_the_planes_move_by():
    path, rng = wandering_path(), np.random.default_rng(2)
    bends = rng.normal(size=7) * [0.1, 0.05, 0.05, 2e-3, 2e-3, 2e-3, 2e-3]
    bent = path.bent(bends)
    twists = path.twists(bends, bent)
    for k in range(len(BENDS)):
        step = 1e-6 * np.eye(7)[k]
        moved = (path.bent(bends + step) - path.bent(bends - step)) @ np.linalg.inv(bent) / 2e-6
        expected = np.stack([*moved[:, :3, 3].T, moved[:, 2, 1], moved[:, 0, 2], moved[:, 1, 0]], axis=1)
        # Yaw turns about an axis that the same step's tilt has moved, by 1e-3 rad at most.
        np.testing.assert_allclose(twists[:, :, k], expected, atol=1e-3 * np.abs(expected).max())


def straight_sweep(travel, image):
    grid = ImageGrid(12, 16, 0.3, 0.35)
    stack = ImageStack(grid)
    for index, z in enumerate(travel):
        stack.keep(index, np.full((12, 16), image(z), np.float32))
    poses = RigidTransform.from_translation(np.outer(travel, [0.0, 0.0, 1.0]))
    return CrossingSweep("sweep", stack, poses, grid.centre_mm, 0.1, 1e-3)


def test_a_hand_that_dwells_does_not_draw_the_images():
    # Grey level in dB rises by 1 per mm; every plane is to show its own place's.
    dwelling = np.sort(np.concatenate([np.linspace(0.0, 10.0, 60), np.full(25, 4.05), np.full(25, 10.0)]))
    sweep = straightened(straight_sweep(dwelling, lambda z: 10 ** (0.1 * z)))
    expected = sweep.path.travel_mm - sweep.path.travel_mm[0]
    inner = slice(2, -2)
    # 0.05 mm is a quarter of the weights' width; weighed alike, frames at the pause draw
    # their neighbours by 0.2.
    np.testing.assert_allclose(sweep.volume[inner, 6, 8], expected[inner], atol=0.05)


def test_frames_return_to_where_they_were():
    travel = np.linspace(0.0, 12.0, 80) + 0.05 * np.sin(np.arange(80))
    given = straight_sweep(travel, lambda z: 1.0 + z)
    straight = straightened(given)
    back = straight.corrected(np.zeros(7)) * RigidTransform.from_translation(-given.centre_mm)
    away = back[0].inv() * back
    np.testing.assert_allclose(away.translation, given.poses.translation, atol=1e-9)
    twice = straight.mirrored().mirrored()
    np.testing.assert_allclose(twice.path.planes, straight.path.planes, atol=1e-12)
    np.testing.assert_array_equal(twice.volume, straight.volume)
