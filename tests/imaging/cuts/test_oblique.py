"""Planes placed anywhere: by points, directions, a frame; and how much of them there is to see."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.cuts.oblique import (
    covering_plane,
)
from speckle3d.imaging.cuts.planes import lateral_line, planes_from_first_frame

GRID = ImageGrid(11, 21, 0.5, 0.5, 1.0)


def test_a_covering_plane_is_as_large_as_what_frames_show():
    poses = RigidTransform.from_translation(np.outer(np.arange(9.0), [0, 0, 1]))
    # Across all frames at depth 4, of a sweep 8 long and 5 wide.
    world_from_plane = RigidTransform.from_components([-20.0, 4.0, 3.0], Rotation.from_euler("X", np.pi / 2))
    plane = covering_plane(world_from_plane, GRID, poses, 0.5, 0.1)
    assert (plane.shape, plane.first_mm) == ((81, 51), pytest.approx((20.0, -3.0)))
    np.testing.assert_allclose(plane.base_mm[0], [0, 4, 0], atol=1e-9)
    with pytest.raises(InvalidInputError, match=r"49\.0 mm"):
        covering_plane(RigidTransform.from_translation([0, 0, 57.0]), GRID, poses, 0.5, 0.1)


def test_planes_of_several_modes_begin_with_one_line_and_show_what_became_longer():
    """Two worlds, one of them 6 % too long: the first frame's line has one place in both pictures."""
    way = np.arange(0, 20, 0.5)
    path = np.outer([*way, *way[::-1]], [0.1, 0.05, 1.0])
    rng, line = np.random.default_rng(4), lateral_line(GRID, 2.5)
    worlds = RigidTransform.from_components(rng.normal(0, 50, (2, 3)), Rotation.random(2, rng=rng))
    poses = {
        "image": worlds[0] * RigidTransform.from_translation(1.06 * path),
        "truth": worlds[1] * RigidTransform.from_translation(path),
    }
    planes = planes_from_first_frame(poses, line, 0.1)
    assert planes["image"].shape == planes["truth"].shape
    assert planes["image"].first_mm == planes["truth"].first_mm
    lengths = []
    for mode, plane in planes.items():
        first = plane.world_from_picture.apply(np.column_stack([[0, 0], line[:, 1], [0, 0]]))
        np.testing.assert_allclose(first, poses[mode][0].apply(line), atol=1e-9)
        lengths.append(np.linalg.norm(poses[mode][way.size].apply(line[0]) - first[0]))
    assert lengths[0] / lengths[1] == pytest.approx(1.06)
    # Large enough for the longer one.
    assert len(planes["truth"].base_mm) == round(1.06 * 19.5 * np.hypot(1.0, 0.1) / 0.1) + 1
