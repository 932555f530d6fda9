"""The digital phantom compounded at known and at reconstructed poses: sizes come out as they are."""

import numpy as np
import pytest
from digital_phantom import LEVEL, Ball, Phantom, by_hand, voxel_volume

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.measures.surface import largest_part, surface_of
from speckle3d.imaging.voxels.volume import compound

GRID = ImageGrid(120, 120, 0.1, 0.1)
STEP_MM = 0.25


def test_a_sphere_swept_by_hand_has_its_size():
    body = Ball((6.0, 6.0, 6.0), 3.0)
    poses = by_hand(120, 12.0, seed=1)
    images = [np.rint(image).astype(np.uint8) for image in Phantom((body,), GRID).images(poses)]
    voxels = compound(images, GRID, poses, STEP_MM)
    surface = largest_part(surface_of(voxels, LEVEL))
    assert voxel_volume(voxels, body, STEP_MM) == pytest.approx(body.volume_mm3, rel=0.005)
    assert surface.volume_mm3 == pytest.approx(body.volume_mm3, rel=0.01)
    assert np.abs(body.depth(surface.vertices_mm)).max() < STEP_MM / 2
