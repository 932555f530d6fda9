"""The rule "plus" against a twin of IGSIO's arithmetic, and what that arithmetic makes of a mean."""

import igsio_twin
import numpy as np
import pytest
from igsio_twin import Clip
from scipy.spatial.transform import RigidTransform, Rotation

from speckle3d.core.errors import InvalidInputError
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


def any_pose(seed):
    rng = np.random.default_rng(seed)
    turned = Rotation.random(FRAMES, rng=rng)
    return RigidTransform.from_components(rng.uniform(-1, 12, (FRAMES, 3)), turned)


@pytest.mark.parametrize("seed", range(8))
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


def in_one_voxel(levels, splat="nearest"):
    """Level of a voxel whose centre all pixels of a row lie at, one after another."""
    levels = np.asarray(levels, np.uint8)
    voxels = VoxelGrid((2, 2, 2), (1.0, 1.0, 1.0), RigidTransform.identity())
    volume = compound(
        levels[None, :, None], ImageGrid(levels.size, 1, 1e-9, 1e-9), RigidTransform.identity(1),
        voxel_grid=voxels, fill_radius=0, splat=splat, rule="plus", voxel_type="uint8",
    )  # fmt: skip
    assert (volume.state > 0).sum() == 1
    linear, clip = splat == "linear", Clip((0, levels.size), (0, 1))
    twin, _ = igsio_twin.paste(levels[None, None], np.zeros((1, 3, 4)), (2, 2, 2), clip, linear)
    assert twin[0, 0, 0] == volume.voxels[0, 0, 0]
    return volume.voxels[0, 0, 0]


@pytest.mark.parametrize("splat", ["nearest", "linear"])
def test_weights_end_where_sixteen_bits_do(splat):
    in_one_voxel(np.random.default_rng(2).integers(0, 256, 600), splat)


def test_single_pixels_come_through_whole():
    stack = Stack(17 / 16, 3)
    stack.images[1:] = stack.images[0]
    stack.poses = RigidTransform.from_translation([[0.01, 0.01, 2 * frame + 0.01] for frame in range(FRAMES)])
    volume, weight = stack.twin()
    assert set(np.unique(weight)) == {0, igsio_twin.ONE_PIXEL}
    for rule in ("mean", "plus"):
        np.testing.assert_array_equal(stack.ours(rule=rule, voxel_type="uint8").voxels, volume)


def test_its_nearest_mean_falls_below_the_mean_of_what_came():
    """36 pixels of 90 to 110 in one voxel, as in the spine's volume: their mean is 100."""
    levels = np.random.default_rng(1).permutation(np.tile(np.arange(90, 111, 4), 6))
    running = 0
    for count, level in enumerate(levels.tolist()):
        running = (level + count * running) // (count + 1)
    assert in_one_voxel(levels) == running
    assert running < levels.mean() - 4


def test_its_linear_mean_sticks_to_what_came_first():
    levels = np.array([100] * 30 + [114] * 200)
    assert in_one_voxel(levels, "linear") == 100
    assert levels.mean() > 112


def test_from_the_256th_pixel_on_nearest_forgets():
    assert in_one_voxel([200] * 255 + [199]) == 199  # 200 * 255/256 + 199/256, cut


def test_linear_shares_too_small_for_a_weight_leave_a_voxel_empty():
    """A share of 0.03 x 0.03 in a voxel across two sides is less than 1/512."""
    poses = RigidTransform.from_translation([[0.03, 0.03, 0.0]])
    voxels = VoxelGrid((2, 2, 2), (1.0, 1.0, 1.0), RigidTransform.identity())
    volume = compound(
        np.full((1, 1, 1), 80, np.uint8), ImageGrid(1, 1, 1.0, 1.0), poses,
        voxel_grid=voxels, fill_radius=0, splat="linear", rule="plus", voxel_type="uint8",
    )  # fmt: skip
    np.testing.assert_array_equal(volume.voxels[:, :, 0], [[80, 80], [80, 0]])
    assert volume.state[1, 1, 0] == 0


def test_only_bytes_as_stored_can_be_kept_in_whole_levels():
    stack = Stack(5 / 16, 1)
    with pytest.raises(InvalidInputError, match=r"rule plus: expected voxels of type uint8, .* got float32"):
        stack.ours(rule="plus")
    stack.images = stack.images.astype(np.float32)
    with pytest.raises(InvalidInputError, match=r"rule plus: expected images of type uint8, .* got float32"):
        stack.ours(rule="plus", voxel_type="uint8")
