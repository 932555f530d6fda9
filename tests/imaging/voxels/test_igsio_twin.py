"""The rule "plus" against a twin of IGSIO's arithmetic, and what that arithmetic makes of a mean."""

import igsio_twin
import numpy as np
import pytest
from igsio_twin import Clip
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.grid import ImageGrid
from speckle3d.imaging.voxels.grid import VoxelGrid
from speckle3d.imaging.voxels.volume import compound

SHAPE = (14, 15, 16)
FRAMES, WIDTH, HEIGHT = 5, 9, 8
EVERY_PIXEL = Clip((0, WIDTH), (0, HEIGHT))


class Stack:
    """Random images whose pixels lie at whole multiples of 2^-10 voxel, and none on a side of a voxel."""

    def __init__(self, pitch, seed):
        rng = np.random.default_rng(seed)
        self.images = rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH), dtype=np.uint8)
        turned = Rotation.create_group("O")[rng.integers(0, 24, FRAMES)]
        middle = np.array([pitch * (WIDTH - 1) / 2, pitch * (HEIGHT - 1) / 2, 0.0])
        centre = np.array(SHAPE) / 2 + rng.integers(-7, 8, (FRAMES, 3))
        start = np.floor(16 * (centre - turned.apply(middle))) / 16 + rng.integers(1, 32, (FRAMES, 3)) / 1024
        self.poses = RigidTransform.from_components(start, turned)
        self.grid = ImageGrid(WIDTH, HEIGHT, pitch, pitch)

    @property
    def maps(self):
        return self.poses.as_matrix()[:, :3] * np.array([self.grid.vector_pitch_mm] * 2 + [1, 1])

    def ours(self, **how):
        voxels = VoxelGrid(SHAPE, (1.0, 1.0, 1.0), RigidTransform.identity())
        images = self.images.transpose(0, 2, 1)
        return compound(images, self.grid, self.poses, voxel_grid=voxels, fill_radius=0, **how)

    def twin(self, **how):
        return igsio_twin.paste(self.images, self.maps, SHAPE, EVERY_PIXEL, **how)


def any_pose(seed):
    rng = np.random.default_rng(seed)
    turned = Rotation.random(FRAMES, rng=rng)
    return RigidTransform.from_components(rng.uniform(-1, 12, (FRAMES, 3)), turned)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("splat", ["nearest", "linear"])
def test_the_rule_plus_is_the_twin(splat, seed):
    """At any pose, over the grid's sides, of a part of the image, stored by rows or by columns."""
    stack, rng = Stack([1 / 64, 5 / 16, 17 / 16, 2.3][seed % 4], seed), np.random.default_rng(seed)
    stack.poses = any_pose(seed)
    region = rng.random((WIDTH, HEIGHT)) < 0.9
    volume, weight = stack.twin(linear=splat == "linear", mask=region.T)
    assert (weight > 0).sum() > 3
    how = {"splat": splat, "rule": "plus", "voxel_type": "uint8", "region": region}
    for stored in (stack.images, stack.images.transpose(0, 2, 1).copy().transpose(0, 2, 1)):
        stack.images = stored
        ours = stack.ours(**how)
        np.testing.assert_array_equal(ours.state > 0, weight > 0)
        np.testing.assert_array_equal(ours.voxels, np.where(weight > 0, volume, 0))
