"""Outlines of frames, and the lines in which frames cross a plane."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.cuts.outlines import crossings, frame_outlines, within_fan
from speckle3d.imaging.images import image_outline

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
    """10 mm below the apex a sector of 60 degrees is 20 tan(30) mm wide."""
    fan = ImageGrid.of_fan(31, 61, 0.5, 0.0, (-np.pi / 6, np.pi / 6))
    radii_mm = np.linalg.norm(image_outline(fan)[:, :2] - fan.fan.apex_mm, axis=1)
    np.testing.assert_allclose(radii_mm, [0.0] * 31 + [30.0] * 31 + [0.0], atol=1e-9)
    lines = fan.fan.apex_mm + np.array([[[-20.0, 10.0], [20.0, 10.0]]])
    (x,) = within_fan(lines, RigidTransform.identity(1), fan)[..., 0]
    assert abs(np.nanmax(x) - np.nanmin(x) - 20.0 / 3**0.5) < 0.4
