"""The digital phantom compounded at known poses: sizes come out as they are."""

import numpy as np
import pytest
from digital_phantom import LEVEL, Ball, Phantom, curved_path

from speckle3d.core.sweep import ImageGrid
from speckle3d.imaging.surface import largest_part, surface_of
from speckle3d.imaging.volume import compound

GRID = ImageGrid(120, 120, 0.1, 0.1)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_a_sphere_swept_by_hand_has_its_size(dtype):
    body = Ball((6.0, 6.0, 6.0), 3.0)
    poses = curved_path(120, 12.0, seed=1)
    images = [
        np.rint(image).astype(dtype) if dtype is np.uint8 else image
        for image in Phantom((body,), GRID).images(poses)
    ]
    voxels = compound(images, GRID, poses, 0.25)
    surface = largest_part(surface_of(voxels, LEVEL))
    assert surface.volume_mm3 == pytest.approx(body.volume_mm3, rel=0.01)
    assert np.abs(body.depth(surface.vertices_mm)).max() < 0.125
