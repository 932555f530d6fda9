"""The twin of IGSIO's arithmetic, and our volumes beside it where both are defined."""

import igsio_twin
import numpy as np
import pytest
from igsio_twin import Clip
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.sweep import ImageGrid
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


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("splat", ["nearest", "linear"])
def test_ours_is_the_twin_s_mean_without_its_rounding(splat, seed):
    stack = Stack(5 / 16, seed)
    ours = stack.ours(splat=splat)
    mean, weight = igsio_twin.exact_mean(stack.images, stack.maps, SHAPE, EVERY_PIXEL, splat == "linear")
    # A pixel between the grid's border and outside counts for the border in ours, and nowhere in IGSIO's.
    same = (slice(1, -1) if splat == "linear" else slice(None),) * 3
    assert (weight[same] > 0).sum() > 40
    np.testing.assert_array_equal(ours.state[same] > 0, weight[same] > 0)
    np.testing.assert_allclose(ours.voxels[same], mean[same], atol=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_maximum_is_that_of_the_twin(seed):
    stack = Stack(5 / 16, seed)
    volume, weight = stack.twin(rule="maximum")
    ours = stack.ours(rule="maximum", voxel_type="uint8")
    np.testing.assert_array_equal(ours.state > 0, weight > 0)
    np.testing.assert_array_equal(ours.voxels, volume)


@pytest.mark.parametrize("seed", range(5))
def test_latest_is_that_of_the_twin_where_an_image_has_one_pixel_in_a_voxel(seed):
    """Of several, IGSIO takes the one read last, and we their mean."""
    stack = Stack(17 / 16, seed)
    volume, weight = stack.twin(rule="latest")
    ours = stack.ours(rule="latest", voxel_type="uint8")
    np.testing.assert_array_equal(ours.state > 0, weight > 0)
    np.testing.assert_array_equal(ours.voxels, volume)


def test_single_pixels_come_through_whole():
    stack = Stack(17 / 16, 3)
    stack.images[1:] = stack.images[0]
    stack.poses = RigidTransform.from_translation([[0.01, 0.01, 2 * frame + 0.01] for frame in range(FRAMES)])
    volume, weight = stack.twin()
    assert set(np.unique(weight)) == {0, igsio_twin.ONE_PIXEL}
    np.testing.assert_array_equal(stack.ours(voxel_type="uint8").voxels, volume)


def test_its_nearest_mean_falls_below_the_mean_of_what_came():
    """36 pixels of 90 to 110 in one voxel, as in the spine's volume: their mean is 100."""
    levels = np.random.default_rng(1).permutation(np.tile(np.arange(90, 111, 4), 6)).astype(np.uint8)
    volume, _ = igsio_twin.paste(levels[None, None], at_rest(36), (1, 1, 1), Clip((0, 36), (0, 1)))
    running = 0
    for count, level in enumerate(levels.tolist()):
        running = (level + count * running) // (count + 1)
    assert volume[0, 0, 0] == running
    assert running < levels.mean() - 4


def test_its_linear_mean_sticks_to_what_came_first():
    levels = np.array([100] * 30 + [114] * 200, np.uint8)
    volume, _ = igsio_twin.paste(
        levels[None, None], at_rest(levels.size), (2, 2, 2), Clip((0, 230), (0, 1)), linear=True
    )
    assert volume[0, 0, 0] == 100
    assert levels.mean() > 112


def test_from_the_256th_pixel_on_nearest_forgets():
    levels = np.array([200] * 255 + [199] * 4, np.uint8)
    volume, weight = igsio_twin.paste(levels[None, None], at_rest(259), (1, 1, 1), Clip((0, 259), (0, 1)))
    assert weight[0, 0, 0] == 255 * 256
    assert volume[0, 0, 0] == 199  # 200 * 255/256 + 199/256 is cut to 199 by the first of them


def test_sticks_take_the_shortest_way_across():
    volume, weight = np.zeros((7, 3, 3), np.uint8), np.zeros((7, 3, 3), np.uint16)
    volume[1, 1, 1], volume[4, 1, 1] = 40, 10
    weight[1, 1, 1] = weight[4, 1, 1] = 256
    filled = igsio_twin.fill_with_sticks(volume, weight)
    # The end ahead counts one step more than the distance behind, of one step more than there are; then cut.
    assert filled[2, 1, 1] == int(0.5 * 10 + 0.5 * 40)  # by distance 1/3 and 2/3
    assert filled[3, 1, 1] == int(0.75 * 10 + 0.25 * 40)  # by distance 2/3 and 1/3
    assert np.count_nonzero(filled) == 4
    assert np.count_nonzero(igsio_twin.fill_with_sticks(volume, weight, longest=3)) == 2


def at_rest(_):
    """Map that puts every pixel at the first voxel's centre."""
    return np.zeros((1, 3, 4))
