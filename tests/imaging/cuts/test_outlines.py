"""Outlines of frames, and the lines in which frames cross a plane."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.cuts.outlines import crossings, frame_outlines, within_fan

GRID = ImageGrid(11, 21, 0.4, 0.5, 1.0)


def test_crossings_are_on_the_plane_and_on_the_outline():
    """Against a dense walk along the line that a frame's and the cut's endless planes share."""
    rng = np.random.default_rng(0)
    poses = RigidTransform.from_components(rng.normal(0, 3, (40, 3)), Rotation.random(40, rng=rng))
    plane = RigidTransform.from_components(rng.normal(0, 1, 3), Rotation.random(rng=rng))
    lines = crossings(frame_outlines(GRID, poses), plane)
    for pose, line in zip(poses, lines, strict=True):
        normals = np.array([frame.rotation.apply([0, 0, 1.0]) for frame in (pose, plane)])
        along = np.cross(*normals)
        offsets = [normals[0] @ pose.translation, normals[1] @ plane.translation, 0.0]
        base = np.linalg.solve([*normals, along], offsets)
        walk = base + np.arange(-60, 60, 0.001)[:, None] * along / np.linalg.norm(along)
        x, y, _ = pose.inv().apply(walk).T
        inside = (x > 0) & (x < 4) & (y > 1) & (y < 11)
        assert inside.any() == np.isfinite(line).all()
        if not inside.any():
            continue
        expected = plane.inv().apply(walk[inside][[0, -1]])[:, :2]
        if y[inside][0] > y[inside][-1]:
            expected = expected[::-1]
        np.testing.assert_allclose(line, expected, atol=2e-3)
    assert 5 < np.isfinite(lines[:, 0, 0]).sum() < 40


def test_lines_end_with_the_fan():
    """A level cut 10 mm below the apex of a sector of 60 degrees is 20 tan(30) mm wide; the box is 34.6."""
    fan = ImageGrid.of_fan(31, 61, 0.5, 0.0, (-np.pi / 6, np.pi / 6))
    frames = RigidTransform.from_translation([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
    turn = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    plane = RigidTransform.from_components([0.0, fan.fan.apex_mm[1] + 10.0, 0.0], turn)
    lines = within_fan(crossings(frame_outlines(fan, frames), plane), plane.inv() * frames, fan)
    np.testing.assert_allclose(np.ptp(lines[..., 0], axis=1), 20.0 / np.sqrt(3.0), atol=0.3)
